"""The paper's method as stages of a run: poses from the map alone, stopped and gone on with, and the switch."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from finished import note_finished

from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import Config, RunConfig
from msgs_slam.pipelines.depth.fields import DepthFields
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.paper import stages
from msgs_slam.pipelines.paper.mapping import grow
from msgs_slam.pipelines.paper.slam import Slam
from msgs_slam.pipelines.paper.uncertainty import PAPER, constants_of
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.run.files import CLASS_IDS, CLASSES, DEPTH_FIELDS, MAP, SPARSE, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.threads import get_threads, set_threads
from msgs_slam.pipelines.types import Trajectory
from tests.networks import save_network
from tests.pipelines.mapping.small_run import make_run

CONFIG = Config(run=RunConfig(method="paper", threads=1))
STAGES = all_stages("paper")[2:5]
FRAMES = 8


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """As a run of these settings has it; threads of a few small images wait for each other longer than they work."""
    before = get_threads(), torch.get_num_threads()
    set_threads(1)
    torch.set_num_threads(1)
    yield
    set_threads(before[0])
    torch.set_num_threads(before[1])


class Interrupted(Exception):
    pass


class StoppingProgress(SilentProgress):
    """Ends the work after so many items of a label."""

    def __init__(self, label: str, after: int) -> None:
        self.label, self.left = label, after

    def track(self, items: Iterable, label: str, total: int | None = None) -> Iterator:
        for item in items:
            if label == self.label:
                if self.left == 0:
                    raise Interrupted
                self.left -= 1
            yield item


def prepared(root: Path, sequence: Path) -> RunFolder:
    run = make_run(root, sequence, every=1, most=FRAMES)
    note_finished(run, ("frames", "proxy"), CONFIG)
    return run


def go(run: RunFolder, number: int, progress: SilentProgress | None = None) -> dict:
    """Run one of the three stages, as far as the progress lets it."""
    stage = STAGES[number]
    folder = run.stage(stage.name)
    folder.mkdir(exist_ok=True)
    figures = stage.run(StageContext(run, run.root, CONFIG, folder, progress or SilentProgress()))
    for left in sorted((folder / "snapshot").glob("*")):
        left.unlink()
    note_finished(run, ("frames", "proxy", *(s.name for s in STAGES[: number + 1])), CONFIG)
    return figures


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, world_sequence: Path) -> RunFolder:
    run = prepared(tmp_path_factory.mktemp("paper") / "whole.msgs", world_sequence)
    for number in range(3):
        go(run, number)
    return run


def test_poses_and_map_come_from_rendering_alone(whole: RunFolder, world_sequence: Path) -> None:
    trajectory = whole.load(TRAJECTORY, "global_ba")
    assert trajectory.is_posed.all()
    true = np.loadtxt(world_sequence / "traj.txt").reshape(-1, 4, 4)[:FRAMES, :3, 3]
    error = np.linalg.norm(align_points(trajectory.centers, true, False).apply(trajectory.centers) - true, axis=1)
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert 0 < np.sqrt((error**2).mean()) < 0.05 * length
    figures = {s.name: (whole.stage(s.name) / f"{s.name}.json") for s in STAGES}
    assert all(path.is_file() for path in figures.values())
    gaussian_map = whole.load(MAP, "global_ba")
    assert len(gaussian_map) > 80 * 60
    assert gaussian_map.class_logits.shape[1] == len(whole.load(CLASS_IDS))
    assert set(whole.load(DEPTH_FIELDS, "global_ba").of_frame) == set(trajectory.frame_ids[trajectory.is_keyframe])
    assert len(whole.load(SPARSE, "global_ba").points_in_world) > 100


@pytest.mark.parametrize(("number", "label", "after"), [(0, "tracking", 6), (2, "mapping", 3), (2, "mapping", 9)])
def test_stopped_and_gone_on_with_it_ends_with_the_same_bytes(
    whole: RunFolder, world_sequence: Path, tmp_path: Path, number: int, label: str, after: int
) -> None:
    run = prepared(tmp_path / "stopped.msgs", world_sequence)
    for before in range(number):  # as the whole run left it
        for path in whole.stage(STAGES[before].name).rglob("*"):
            if path.is_file():
                copy = run.stage(STAGES[before].name) / path.relative_to(whole.stage(STAGES[before].name))
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(path.read_bytes())
    note_finished(run, ("frames", "proxy", *(s.name for s in STAGES[:number])), CONFIG)
    with pytest.raises(Interrupted):
        go(run, number, StoppingProgress(label, after))
    snapshots = list((run.stage(STAGES[number].name) / "snapshot").iterdir())
    assert snapshots
    go(run, number)
    for name in ("trajectory.npz", "map.safetensors"):
        stage = STAGES[number].name
        assert (run.stage(stage) / name).read_bytes() == (whole.stage(stage) / name).read_bytes()


def test_a_loop_that_is_measured_moves_everything(whole: RunFolder) -> None:
    """The last keyframe is said to be where the graph has it: nothing moves; a hand's breadth away: it follows."""
    trajectory = whole.load(TRAJECTORY, "mapping")
    ids = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    context = StageContext(whole, whole.root, CONFIG, whole.stage("global_ba"), SilentProgress())
    recording, fields = stages.FrameViews(context), whole.load(DEPTH_FIELDS, "tracking")
    gaussian_map = whole.load(MAP, "mapping")
    first, last = (trajectory.cam_from_world[i] for i in (ids[0], ids[-1]))
    motion = last @ np.linalg.inv(first)
    edge = stages.LoopEdge(ids[0], ids[-1], motion, 1.0, 100)
    same, _ = stages._closed(recording, trajectory, fields, gaussian_map, [edge])
    assert np.allclose(same.cam_from_world, trajectory.cam_from_world, atol=1e-6)
    away = motion.copy()
    away[0, 3] += 0.1
    moved, moved_map = stages._closed(
        recording, trajectory, fields, gaussian_map, [replace(edge, frame2_from_frame1=away)]
    )
    shift = np.linalg.norm(moved.centers - trajectory.centers, axis=1)
    assert shift[ids[0]] < 1e-9
    assert 0.01 < shift[ids[-1]] < 0.1
    assert not np.allclose(moved_map.means, gaussian_map.means)


def test_a_frame_without_a_pose_measures_nothing(whole: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its pose is the identity, from which the map looks like anything but the frame."""
    recording = stages.FrameViews(StageContext(whole, whole.root, CONFIG, whole.stage("tracking"), SilentProgress()))
    trajectory, fields = whole.load(TRAJECTORY, "tracking"), whole.load(DEPTH_FIELDS, "tracking")
    recording.held = {1, 2}
    place = np.arange(len(trajectory.frame_ids))
    reasons = tuple("lost" if i == 2 else "" for i in place.tolist())
    some = replace(trajectory, is_keyframe=trajectory.is_keyframe & ~np.isin(place, [1, 2]), lost_reasons=reasons)
    measured: list[int] = []
    monkeypatch.setattr(stages, "measure_view", lambda gaussian_map, view, *rest: measured.append(view.frame_id))
    monkeypatch.setattr(stages, "mean_figures", lambda found, name: {})
    stages._measure(recording, whole.load(MAP, "tracking"), some, fields)
    assert {0, 1} < set(measured)
    assert 2 not in measured


def test_the_switch_changes_three_stages_and_what_proxies_are() -> None:
    default, chosen = all_stages(), all_stages("paper")
    assert [s.name for s in default] == [s.name for s in chosen]
    rooms = [s.program.split()[-1].partition(".")[0] for s in chosen]
    assert rooms == ["frames", "proxy", "paper", "paper", "paper", "export"]


def test_a_pose_stays_a_rotation_however_long_the_path(whole: RunFolder) -> None:
    """What rounding adds grows 2.4 times with each prediction of (15) unless a pose is made a rotation again."""
    recording = stages.FrameViews(StageContext(whole, whole.root, CONFIG, whole.stage("tracking"), SilentProgress()))
    view = recording.views[0]
    slam = Slam(len(recording.class_ids), 0)
    slam._begin(view, PAPER)
    off = np.eye(4)
    off[:3, :3] *= 1 + 1e-4
    kept = slam._adjusted_frame(view, off, recording.views.__getitem__, PAPER)[:3, :3]
    assert np.abs(kept @ kept.T - np.eye(3)).max() < 1e-12


def test_kappa_is_a_setting() -> None:
    given = load_config(overrides=["run.method=paper", "run.kappa=5"])
    assert constants_of(given).kappa == 5
    assert constants_of(CONFIG) == PAPER


def dinov2_like(folder: Path) -> Path:
    """A card of a network with DINOv2's inputs and outputs and made weights: a token of 14 x 14 pixels is their mean
    colour, and the class token that of the image."""
    save_network(
        folder / "dinov2.onnx",
        "float[1, 3, height, width] pixel_values",
        "float[1, tokens, 3] last_hidden_state",
        "means = AveragePool <kernel_shape = [14, 14], strides = [14, 14]> (pixel_values)",
        "mean = GlobalAveragePool (pixel_values)",
        "patches = Reshape (means, shape)",
        "whole = Reshape (mean, shape)",
        "both = Concat <axis = 2> (whole, patches)",
        "last_hidden_state = Transpose <perm = [0, 2, 1]> (both)",
        shape=[1, 3, -1],
    )
    (folder / "card.toml").write_text(
        'task = "segmentation"\nmodel = "dinov2.onnx"\ninput = "pixel_values"\noutput = "last_hidden_state"\n'
        'kind = "tokens"\nwhite = 1.0\nmean = [0.485, 0.456, 0.406]\nstd = [0.229, 0.224, 0.225]\nmultiple = 14\n'
    )
    return folder / "card.toml"


def test_features_of_dinov2_reach_labels_and_loops(
    tmp_path: Path, world_sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    words = [str(world_sequence), "--out", str(run.root), "--until", "proxy", "--method", "paper", "--depth", "files"]
    chosen = ["--semantics", f"onnx:{dinov2_like(tmp_path)}", "--set", "frames.rate=2"]
    done = CliRunner().invoke(main, ["reconstruct", *words, *chosen])
    assert done.exit_code == 0, done.output
    config = run.settings()
    (folder := tmp_path / "global_ba").mkdir()
    context = StageContext(run, run.root, config, folder, SilentProgress())
    recording = stages.FrameViews(context)
    ids = [f.id for f in recording.frames]
    image = torch.stack([recording.views[i].colors.mean((0, 1)) for i in ids]).double().numpy()
    seen = (image - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    asked = []

    def noted(summaries: list, looks: np.ndarray, constants: object) -> list:
        asked.append((summaries, looks))
        return []

    monkeypatch.setattr(stages, "semantic_candidates", noted)
    every = np.ones(len(ids), bool)
    poses = np.tile(np.eye(4), (len(ids), 1, 1))
    trajectory = Trajectory(np.array(ids), np.arange(len(ids), dtype=float), poses, every, ("",) * len(ids))
    at_first = torch.eye(4, dtype=torch.float64)
    first = grow(None, recording.views[ids[0]], at_first, len(recording.class_ids)).map
    stages._loops(context, recording, trajectory, DepthFields({}), first)
    ((summaries, looks),) = asked
    assert looks.shape == (len(ids), 3)
    assert np.abs(looks - seen).max() < 0.05, "the class token, a unit vector"
    assert {name.split()[0] for name in run.load(CLASSES).names} == {"cluster"}
    for i, summary in zip(ids, summaries, strict=True):
        labels = summary.labels
        colors = np.array(
            cv2.resize(recording.views[i].image.numpy(), labels.shape[::-1], interpolation=cv2.INTER_AREA)
        )
        spread = [colors[labels == c].std(0).mean() for c in np.unique(labels[labels != 255])]
        assert len(spread) > 1
        assert np.mean(spread) < 0.8 * colors.reshape(-1, 3).std(0).mean(), "alike in colour is alike in class"
