"""The stage from what the stages before it left: the map follows a closed loop, an interruption changes nothing."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.depth.fields import FINE, DepthFields
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import unproject
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.global_ba.loops import FoundLoops
from msgs_slam.pipelines.global_ba.stage import run as run_global_ba
from msgs_slam.pipelines.mapping.views import occurring_classes
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.run.files import (
    BACKBONE,
    CALIBRATION,
    DEPTH_FIELDS,
    EXPOSURE,
    LOOPS,
    MAP,
    PROXY_MAPS,
    SPARSE,
    TRAJECTORY,
)
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.types import Trajectory
from tests.pipelines.tracking.conftest import MadeRun, make_run, open_stage, room_frames, small_motion
from tests.world.clip import WorldFrame

__all__ = ["make_run", "open_stage", "room_frames"]
Array = NDArray[np.float64]
FIRST_AGAIN = 12
"""From this keyframe on the points carry new numbers, as after a walk that came back without noticing."""


def finish_mapping(made: MadeRun, frames: list[WorldFrame], slip: Similarity) -> None:
    """What tracking and mapping would have left: a second half that has drifted by `slip`, and a map of one Gaussian a
    sample."""
    run = made.run
    backbone = run.find(BACKBONE)
    assert backbone is not None
    tracking, mapping = run.stage("tracking"), run.stage("mapping")
    tracking.mkdir()
    mapping.mkdir()
    # As after an adjustment: keyframes where they belong, but for the slip.
    model = doubled(replace(backbone, cam_from_world=made.cam_from_world[backbone.frame_ids]), slip)
    SPARSE.save(tracking, model)
    keyframes = model.frame_ids.tolist()
    scale = {k: slip.scale if k >= FIRST_AGAIN else 1.0 for k in keyframes}
    fields = {k: np.full((FINE.rows, FINE.columns), np.log(s)) for k, s in scale.items()}
    DEPTH_FIELDS.save(tracking, DepthFields(fields if slip.scale != 1 else {}))
    poses = made.cam_from_world.copy()
    poses[FIRST_AGAIN:] = slip.apply_to_poses(poses[FIRST_AGAIN:])
    ids = np.arange(len(frames))
    trajectory = Trajectory(ids, ids / 10, poses, np.isin(ids, model.frame_ids), ("",) * len(frames))
    TRAJECTORY.save(mapping, trajectory)
    class_ids = occurring_classes([run.load(PROXY_MAPS, of=k).labels for k in keyframes])
    scaled = [replace(f, depth=f.depth * scale.get(i, 1.0)) for i, f in enumerate(frames)]
    MAP.save(mapping, seeded_map(scaled, poses, keyframes, run, len(class_ids)))
    nothing = np.zeros((len(keyframes), 3), np.float32)
    EXPOSURE.save(mapping, {"frame_ids": model.frame_ids, "log_gains": nothing, "offsets": nothing})
    write_json(mapping / "mapping.json", {"class_ids": list(class_ids)})


def doubled(model: SparseModel, slip: Similarity) -> SparseModel:
    """The model with the keyframes from FIRST_AGAIN on, and their own copies of the points, moved by `slip`."""
    late = model.frame_ids >= FIRST_AGAIN
    poses = model.cam_from_world.copy()
    poses[late] = slip.apply_to_poses(poses[late])
    points = np.concatenate([model.points_in_world, slip.apply(model.points_in_world)])
    numbers = model.obs_point + len(model.points_in_world) * late[model.obs_frame]
    colors = np.concatenate([model.colors, model.colors])
    return SparseModel(model.frame_ids, poses, points, colors, model.obs_frame, numbers, model.obs_xy)


def seeded_map(
    frames: list[WorldFrame], poses: Array, keyframes: list[int], run: RunFolder, classes: int
) -> GaussianMap:
    intrinsics = run.load(CALIBRATION).intrinsics
    means, colors, anchors = [], [], []
    for k in keyframes:
        rows, columns = (x.ravel() for x in np.mgrid[4:240:8, 4:320:8])
        depth = frames[k].depth[rows, columns].astype(float)
        in_cam = unproject(np.stack([columns, rows], 1) + 0.5, depth, intrinsics)
        means.append(se3.transform(se3.inverse(poses[k]), in_cam))
        colors.append(frames[k].rgb[rows, columns] / 255)
        anchors.append(np.full(len(rows), k))
    count = sum(len(m) for m in means)
    return GaussianMap(
        torch.tensor(np.concatenate(means), dtype=torch.float32),
        torch.full((count,), -3.5),
        torch.full((count,), 2.0),
        torch.tensor(np.concatenate(colors), dtype=torch.float32),
        torch.zeros(count, classes),
        torch.tensor(np.concatenate(anchors)),
    )


@pytest.fixture
def mapped(
    tmp_path: Path,
    make_run: Callable[..., MadeRun],
    room_frames: tuple[object, list[WorldFrame]],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], MadeRun]:
    """mapped(name): a run whose mapping is done, in which keyframes near each other may make a loop."""
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.loops.GAP", 2)

    def make(name: str) -> MadeRun:
        made = make_run(tmp_path / name, keyframes=tuple(range(0, 24, 2)), backbone_scale=1.0)
        slip = small_motion(np.random.default_rng(5), 0.006, 0.03)
        finish_mapping(made, room_frames[1], Similarity(1.0, slip[:3, :3], slip[:3, 3]))
        return made

    return make


def finish(context: StageContext) -> dict:
    figures = run_global_ba(context)
    shutil.rmtree(context.folder / "snapshot", ignore_errors=True)
    context.folder.rename(context.run.stage("global_ba"))
    return figures


def error(poses: Array, truth: Array) -> float:
    centres, wanted = se3.inverse(poses)[:, :3, 3], se3.inverse(truth)[:, :3, 3]
    moved = align_points(centres, wanted).apply(centres)
    return float(np.sqrt(((moved - wanted) ** 2).sum(1).mean()))


def test_a_loop_is_closed_and_the_map_goes_along(
    mapped: Callable[[str], MadeRun], open_stage: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.loops.MIN_ALIKE", -1.0)
    made = mapped("run")
    before = error(made.run.load(TRAJECTORY, "mapping").cam_from_world, made.cam_from_world)
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.stage.JOINT_PX", np.inf)
    figures = finish(open_stage(made.run, "global_ba", load_config()))
    assert figures["loops"] >= 1
    assert figures["moved_px"] > 0.5
    after = made.run.load(TRAJECTORY, "global_ba")
    assert 0 < error(after.cam_from_world, made.cam_from_world) < 0.5 * before
    assert all(e.inliers >= 25 for e in made.run.load(LOOPS))
    # The late keyframes' Gaussians are again where the early ones see the same surfaces.
    old, new = made.run.load(MAP, "mapping"), made.run.load(MAP, "global_ba")
    late = old.anchor_frame_ids >= FIRST_AGAIN
    early_shift, late_shift = ((new.means - old.means)[x].norm(dim=1).median() for x in (~late, late))
    assert abs(float(early_shift) - float(late_shift)) > 0.002
    assert torch.equal(old.colors, new.colors)


def test_without_loops_nothing_moves(
    mapped: Callable[[str], MadeRun], open_stage: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = mapped("run")
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.stage.GlobalStage.search", lambda *_: FoundLoops([], 0, 0, 0))
    figures = finish(open_stage(made.run, "global_ba", load_config()))
    assert figures["loops"] == 0
    assert figures["joint"] == "not run"
    for name in ("trajectory.npz", "map.safetensors"):
        assert (made.run.stage("global_ba") / name).read_bytes() == (made.run.stage("mapping") / name).read_bytes()


def test_joint_refinement_is_kept_only_where_it_helps_and_survives_interruption(
    mapped: Callable[[str], MadeRun], open_stage: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.stage.JOINT_PASSES", 2.0)
    whole, broken = mapped("a"), mapped("b")
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.stage.JOINT_PX", 0.0)
    monkeypatch.setattr("msgs_slam.pipelines.mapping.optimise.SNAPSHOT_EVERY", 4)
    config: Config = load_config(overrides=["mapping.max_side=128"])
    figures = finish(open_stage(whole.run, "global_ba", config))
    assert figures["joint"] in ("kept", "thrown away")
    assert (figures["joint"] == "kept") == (figures["joint_psnr_after"] >= figures["joint_psnr_before"])
    context = open_stage(broken.run, "global_ba", config)
    keyframes = int(broken.run.load(TRAJECTORY, "mapping").is_keyframe.sum())  # a snapshot comes once a pass at most
    with pytest.raises(KeyboardInterrupt):
        run_global_ba(
            StageContext(context.run, context.source, config, context.folder, BreakOff("refining", keyframes + 3))
        )
    assert (context.snapshot / "loops.npz").exists()
    assert (context.snapshot / "submaps_1" / "refined_state_0000.safetensors").exists()
    finish(open_stage(broken.run, "global_ba", config))
    for name in ("trajectory.npz", "map.safetensors", "sparse.npz", "loops.json"):
        assert (whole.run.stage("global_ba") / name).read_bytes() == (broken.run.stage("global_ba") / name).read_bytes()


class BreakOff:
    """Progress that stops in the middle of one piece of work."""

    def __init__(self, label: str, after: int) -> None:
        self.label, self.after = label, after

    def track(self, items, label, total=None):  # type: ignore[no-untyped-def]
        for n, item in enumerate(items):
            if label == self.label and n == self.after:
                raise KeyboardInterrupt
            yield item
