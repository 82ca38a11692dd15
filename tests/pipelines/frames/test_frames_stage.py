"""The whole stage on a rendered walk: accuracy, bytes, going on after a kill, and what it refuses."""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest

from msgs_slam.formats.errors import DiskFullError, InputError
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.formats.textfile import read_json
from msgs_slam.pipelines.frames.stage import run
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, FRAMES, SPARSE
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm import driver as sfm
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.source.recording import open_recording
from msgs_slam.pipelines.system.machine import windows_of
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.values import dataclass_from_json
from msgs_slam.pipelines.types import Calibration
from tests.killed import KillAt, Killed
from tests.pipelines.frames.conftest import QUICK, WALK_FRAMES, Walk, render, sideways, turn, write_walk
from tests.pipelines.travelling import Travelling

T = TypeVar("T")


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every result, the snapshots left out."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and "snapshot" not in p.parts]
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="session")
def finished(bent_walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> tuple[StageContext, dict]:
    root = tmp_path_factory.mktemp("finished")
    (root / "frames").mkdir()
    config = load_config(overrides=QUICK)
    context = StageContext(RunFolder(root), bent_walk.folder, config, root / "frames", SilentProgress())
    return context, run(context)


def test_the_walk_is_recovered(finished: tuple[StageContext, dict], bent_walk: Walk) -> None:
    context, figures = finished
    calibration = context.run.load(CALIBRATION)
    assert calibration.origin == "self-calibrated"
    error = abs(calibration.intrinsics.fx / bent_walk.focal - 1)
    assert 0 < error < 0.02
    assert 0 < calibration.focal_sd < 0.1 * bent_walk.focal
    assert abs(calibration.distortion[0] - bent_walk.k1) < 0.03
    model = context.run.find(BACKBONE)
    assert model is not None
    assert len(model.frame_ids) == figures["keyframes"] >= 8
    centers = -np.einsum("nji,nj->ni", model.cam_from_world[:, :3, :3], model.cam_from_world[:, :3, 3])
    truth = bent_walk.centers[model.frame_ids]
    errors = np.linalg.norm(align_points(centers, truth).apply(centers) - truth, axis=1)
    assert 0 < np.sqrt((errors**2).mean()) < 0.01  # of a walk of 1.9 m


def test_workers_leave_the_same_bytes(
    bent_walk: Walk,
    make_context: Callable[..., StageContext],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sfm, "windows_of", lambda count, _: windows_of(count, 7, 3))
    whole, workers = make_context(bent_walk.folder, name="whole"), Travelling(2)
    divided = replace(make_context(bent_walk.folder, name="divided"), workers=workers)
    assert run(divided) == run(whole)
    assert digests(divided.folder) == digests(whole.folder)
    assert workers.done == {"extract_features": 6, "match_pairs": 1, "map_windows": 2}


def test_points_reproject_into_the_undistorted_frames(finished: tuple[StageContext, dict]) -> None:
    context, _ = finished
    model, matrix = context.run.find(BACKBONE), context.run.load(CALIBRATION).intrinsics.matrix
    assert model is not None
    np.testing.assert_array_equal(model.cam_from_world[0], np.eye(4))
    poses = model.cam_from_world[model.obs_frame]
    points = (poses[:, :3, :3] @ model.points_in_world[model.obs_point][..., None])[..., 0] + poses[:, :3, 3]
    assert (points[:, 2] > 0).all()
    assert np.median(points[:, 2]) == pytest.approx(1.0)
    projected = points @ matrix.T
    error = np.linalg.norm(projected[:, :2] / projected[:, 2:] - model.obs_xy, axis=1)
    assert 0 < np.median(error) < 0.5
    assert error.max() < 6
    frames = context.run.load(FRAMES)
    first = model.obs_frame == 0
    rgb = context.run.image(frames[model.frame_ids[0]])
    x, y = model.obs_xy[first].astype(int).clip(0, [rgb.shape[1] - 1, rgb.shape[0] - 1]).T
    difference = np.abs(rgb[y, x].astype(int) - model.colors[model.obs_point[first]])
    assert np.median(difference) < 20


def test_what_was_asked_of_a_model_is_not_saved_with_it(finished: tuple[StageContext, dict], tmp_path: Path) -> None:
    context, _ = finished
    model = context.run.find(BACKBONE)
    assert model is not None
    assert model.tree.n == model.seen.shape[0] == len(model.centers)
    assert SPARSE.save(tmp_path, model).read_bytes() == BACKBONE.path(context.folder).read_bytes()


def test_frames_are_undistorted(finished: tuple[StageContext, dict], bent_walk: Walk) -> None:
    context, _ = finished
    center, rotation = list(sideways(WALK_FRAMES))[5]
    frame = context.run.load(FRAMES)[5]
    straight = render(center, rotation, bent_walk.focal).astype(float)
    ours = context.run.image(frame).astype(float)
    bent = read_rgb(bent_walk.folder / frame.name).astype(float)
    assert frame.name == "view_005.png"
    assert np.abs(ours - straight).mean() < 0.6 * np.abs(bent - straight).mean()


def test_a_stage_killed_again_and_again_ends_with_the_same_bytes(
    finished: tuple[StageContext, dict],
    bent_walk: Walk,
    make_context: Callable[..., StageContext],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sfm, "_PAIRS_PER_BLOCK", 16)
    places = [
        ("picking", 7),
        ("keyframes", 5),
        ("features", 3),
        ("matches", 1),
        ("camera model", 1),
        ("undistorting", 4),
    ]
    for label, item in places:
        with pytest.raises(Killed):
            run(make_context(bent_walk.folder, progress=KillAt(item, label)))
    again = make_context(bent_walk.folder)
    extracted = {p.name: p.stat().st_mtime_ns for p in (again.snapshot / "features").iterdir()}
    assert run(again) == finished[1]
    assert digests(again.folder) == digests(finished[0].folder)
    assert {p.name: p.stat().st_mtime_ns for p in (again.snapshot / "features").iterdir()} == extracted


def test_structure_from_motion_is_not_begun_without_room_for_it(tmp_path: Path) -> None:
    """Asked of the system, not of the free bytes: those tell nothing of the largest file allowed."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, before[1]))
    try:
        with pytest.raises(DiskFullError, match="needs 30 MB of disk"):
            Snapshots(tmp_path).model("global", lambda work: pytest.fail("COLMAP was called"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.rglob("room*"))


class ActAt(SilentProgress):
    """Does something when the n-th item of a bar has been handed out."""

    def __init__(self, label: str, item: int, act: Callable[[], object]) -> None:
        self._label, self._item, self._act = label, item, act

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        for i, item in enumerate(items):
            if label == self._label and i == self._item:
                self._act()
            yield item


def test_pictures_that_change_while_they_are_read_are_noticed_and_later_ones_do_not_matter(
    finished: tuple[StageContext, dict], bent_walk: Walk, tmp_path: Path
) -> None:
    """One vanishes while they are picked, which the stage says; one is exchanged when all have been: they are not read
    again."""
    folder = tmp_path / "walk"
    shutil.copytree(bent_walk.folder, folder)
    digest = open_recording(folder, "images").digest

    def same_source() -> None:
        if open_recording(folder, "images").digest != digest:
            raise InputError("the source has changed")

    def bring(label: str, item: int, act: Callable[[], object]) -> dict:
        context, work = finished[0], ActAt(label, item, act)
        return run(StageContext(context.run, folder, context.config, place, work, same_source=same_source))

    place = tmp_path / "frames"
    place.mkdir()
    picture = folder / "view_007.png"
    with pytest.raises(InputError, match="has changed"):
        bring("picking", 2, picture.unlink)
    assert not (place / "snapshot" / "picked.json").exists()
    shutil.rmtree(place)
    shutil.copytree(bent_walk.folder, folder, dirs_exist_ok=True)

    shutil.copytree(finished[0].folder, place)  # with its snapshots: all but the frames is done
    for frame in place.glob("*.png"):
        frame.unlink()
    other = (folder / "view_003.png").read_bytes()
    assert bring("undistorting", 0, lambda: picture.write_bytes(other)) == finished[1]
    assert digests(place) == digests(finished[0].folder)


def test_given_intrinsics_are_kept(bent_walk: Walk, make_context: Callable[..., StageContext]) -> None:
    intrinsics = f"{bent_walk.focal},{bent_walk.focal},160,120,{bent_walk.k1},0,0,0"
    context = make_context(bent_walk.folder, f"frames.intrinsics={intrinsics}")
    figures = run(context)
    calibration = dataclass_from_json(Calibration, read_json(context.folder / "calibration.json"))
    assert (calibration.origin, calibration.focal_sd) == ("given", 0.0)
    assert calibration.distortion == (bent_walk.k1, 0.0, 0.0, 0.0)
    assert calibration.intrinsics.fx == pytest.approx(bent_walk.focal)  # barrel distortion needs no zoom
    assert figures["keyframes_placed"] == figures["keyframes"]
    model = SPARSE.read(context.folder / "backbone" / "model.npz")
    centers = -np.einsum("nji,nj->ni", model.cam_from_world[:, :3, :3], model.cam_from_world[:, :3, 3])
    truth = bent_walk.centers[model.frame_ids]
    assert np.linalg.norm(align_points(centers, truth).apply(centers) - truth, axis=1).max() < 0.01


def test_frames_of_a_good_lens_are_the_source_byte_for_byte(
    tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    walk = write_walk(tmp_path / "straight", sideways(8))
    context = make_context(walk.folder, "frames.intrinsics=280,280,160,120")
    run(context)
    for path in walk.folder.iterdir():
        assert (context.folder / path.name).read_bytes() == path.read_bytes()


def test_a_camera_that_stands_still_is_refused(tmp_path: Path, make_context: Callable[..., StageContext]) -> None:
    rng = np.random.default_rng(0)
    view = render(np.zeros(3), turn(0.0)).astype(float)
    for i in range(6):
        noisy = np.clip(view + rng.normal(0, 3, view.shape), 0, 255).astype(np.uint8)
        write_rgb(tmp_path / "still" / f"{i}.png", noisy)
    with pytest.raises(InputError, match=r"no parallax.*stands still.*walking"):
        run(make_context(tmp_path / "still"))


def test_images_without_detail_are_not_called_a_camera_that_stands_still(
    tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    for i in range(6):
        write_rgb(tmp_path / "dark" / f"{i}.png", np.full((240, 320, 3), i, np.uint8))
    with pytest.raises(InputError, match=r"^no image shows detail .* dark, of plain surfaces"):
        run(make_context(tmp_path / "dark"))


def test_a_camera_that_only_turns_is_refused(tmp_path: Path, make_context: Callable[..., StageContext]) -> None:
    turns = ((np.zeros(3), turn(a, 0.1 * np.sin(5 * a))) for a in np.linspace(-0.5, 0.3, 12))
    walk = write_walk(tmp_path / "turning", turns)
    with pytest.raises(InputError, match=r"no parallax.*turning.*walking"):
        run(make_context(walk.folder))


def test_views_without_anything_in_common_are_refused(
    tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    rng = np.random.default_rng(1)
    for i in range(5):
        noise = cv2.resize(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8), (320, 240))
        write_rgb(tmp_path / "noise" / f"{i}.png", noise)
    with pytest.raises(InputError, match="no structure"):
        run(make_context(tmp_path / "noise"))


def test_an_unreadable_image_is_left_out_with_a_warning(
    bent_walk: Walk, tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    folder = tmp_path / "damaged"
    shutil.copytree(bent_walk.folder, folder)
    (folder / "view_004.png").write_bytes(b"\x89PNG\r\n not really")
    context = make_context(folder, "frames.intrinsics=280,280,160,120,-0.06,0,0,0", "frames.mapper=incremental")
    figures = run(context)
    assert figures["frames"] == WALK_FRAMES - 1
    assert figures["mapper"] == "incremental"
    assert figures["keyframes_placed"] == figures["keyframes"]
    assert any("view_004.png" in w for w in context.warnings)
    assert not (context.folder / "view_004.png").exists()


def test_what_shows_another_place_is_a_piece_of_its_own(
    tmp_path: Path, make_context: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A walk, cut to the walk through the mirrored room, of which no picture fits the others."""
    monkeypatch.setattr("msgs_slam.pipelines.sfm.driver.LEAST_PIECE", 5)
    folder = tmp_path / "both"
    walk = write_walk(folder, sideways(WALK_FRAMES))
    for i, (center, rotation) in enumerate(sideways(8)):
        write_rgb(folder / f"view_{WALK_FRAMES + i:03d}.png", np.ascontiguousarray(render(center, rotation)[:, ::-1]))
    context = make_context(folder)
    run(context)
    context.folder.rename(context.run.stage("frames"))
    backbone, pieces = context.run.find(BACKBONE), context.run.pieces("frames")
    assert backbone is not None
    assert len(pieces) == 1
    piece = context.run.load(SPARSE, "frames", piece=pieces[0])
    assert backbone.frame_ids.max() < WALK_FRAMES <= piece.frame_ids.min()
    assert len(backbone.frame_ids) >= 10
    assert len(piece.frame_ids) >= 6
    assert any("consistent with each other" in w for w in context.warnings)
    truth = np.array([center for center, _ in sideways(8)])[piece.frame_ids - WALK_FRAMES] * [-1, 1, 1]
    found = np.linalg.inv(piece.cam_from_world)[:, :3, 3]
    moved = align_points(found, truth, with_scale=True).apply(found)
    assert 0 < np.linalg.norm(moved - truth, axis=1).max() < 0.03 < np.ptp(walk.centers[:, 0])
