"""A long recording's windows, joined to one model."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.frames.inputs import frames_division
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.run.ending import checksums
from msgs_slam.pipelines.run.files import CALIBRATION
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.reads import Reads, StageRecord
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.adjust import adjust_model, model_errors
from msgs_slam.pipelines.sfm.joining import Joined, adjust_together
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.rolling import NO_READOUT
from msgs_slam.pipelines.system.machine import WINDOW, WINDOW_OVERLAP, window_size, windows_of
from msgs_slam.pipelines.types import Calibration, Intrinsics
from tests.world.paths import look_at

Array = NDArray[np.float64]
CAMERA = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
COUNT = 40


def path() -> Array:
    """(N, 4, 4) cam_from_world of a walk along a wall."""
    t = np.arange(COUNT) / 10
    center = np.stack([1.5 * t, 0.2 * np.sin(3 * t), 0.2 * np.sin(2 * t)], axis=1)
    ahead = np.stack([0.2 * np.sin(2 * t), np.ones_like(t), 0.1 * np.sin(t)], axis=1)
    return np.linalg.inv(look_at(center, center + ahead, roll=0.05 * np.sin(t)))


def seen() -> tuple[Array, list[list[tuple[int, Array]]]]:
    """Points, and for each view which of them it sees where, half a pixel off."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, 1.5, -1.5], [8, 4, 1.5], (900, 3))
    views = []
    for pose in path():
        xy, depth = project(points @ pose[:3, :3].T + pose[:3, 3], CAMERA)
        inside = np.flatnonzero((depth > 0) & (xy > 0).all(1) & (xy < [CAMERA.width, CAMERA.height]).all(1))
        views.append([(int(p), xy[p] + rng.normal(0, 0.5, 2)) for p in inside])
    return points, views


def model_of(window: range, move: Similarity, noise: float) -> tuple[pycolmap.Reconstruction, list[Array]]:
    """A window as a mapper leaves it: in a world and a unit of its own, points and places a little off."""
    points, views = seen()
    rng, model = np.random.default_rng(window.start), pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(unknown_camera(CAMERA.width, CAMERA.height, CAMERA.fx, is_prior=True))
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for n, (k, pose) in enumerate(zip(window, move.apply_to_poses(path()[window.start : window.stop]), strict=True), 1):
        pixels = pycolmap.Point2DList([pycolmap.Point2D(xy) for _, xy in views[k]])
        pose = se3.exp(rng.normal(0, noise, 6) * move.scale) @ pose
        image = pycolmap.Image(name=str(n), points2D=pixels, camera_id=1, image_id=n)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        for at, (p, _) in enumerate(views[k]):
            tracks.setdefault(p, []).append(pycolmap.TrackElement(n, at))
    for p, elements in tracks.items():
        if len(elements) > 1:
            xyz = move.apply(points[p]) + rng.normal(0, noise, 3)
            model.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    return model, [np.array([xy for _, xy in views[k]]) for k in range(COUNT)]


def off_by(model: pycolmap.Reconstruction) -> Array:
    """(N,) distances of the camera centres from the true ones, after Sim(3)."""
    found = np.array([model.images[i].projection_center() for i in range(1, COUNT + 1)])
    wanted = se3.inverse(path())[:, :3, 3]
    return np.linalg.norm(align_points(found, wanted).apply(found) - wanted, axis=1)


def moves() -> list[Similarity]:
    turns = se3.exp(np.array([[0, 0, 0, 0, 0, 0], [1, 2, 3, 0.3, -0.5, 1.0], [-5, 0, 1, 2.0, 0.1, 0.2]]))
    return [Similarity(s, t[:3, :3], t[:3, 3]) for s, t in zip((1.0, 0.4, 2.5), turns, strict=True)]


def test_windows_hold_all_keyframes_and_share_some() -> None:
    assert windows_of(int(1.5 * WINDOW)) == [range(int(1.5 * WINDOW))]
    for count in (751, 1000, 2000, 5601):
        windows = windows_of(count)
        assert windows[0].start == 0
        assert windows[-1].stop == count
        assert all(WINDOW / 2 < len(w) <= 1.5 * WINDOW for w in windows)
        assert all(a.stop - b.start == WINDOW_OVERLAP for a, b in pairwise(windows))


def test_the_memory_that_is_given_decides_how_large_windows_are() -> None:
    assert window_size(0, 27648) == window_size(4000, 27648) == WINDOW  # a machine's own memory decides nothing
    assert [window_size(m, 27648) for m in (100, 700, 1000)] == [100, 177, 354]
    assert window_size(1000, 307200) < 354  # of larger pictures
    assert all(len(w) <= 1.5 * 177 for w in windows_of(2272, window_size(700, 27648)))
    least = window_size(100, 27648)
    for count in range(2 * least, 20 * least):  # what joins them remembers the window before only
        windows = windows_of(count, least)
        assert all(after.start >= w.stop for w, after in zip(windows, windows[2:], strict=False))


def test_windows_of_three_worlds_become_one_model() -> None:
    joined, windows = Joined(), windows_of(COUNT, 17, 6)
    assert len(windows) == 3
    for window, move in zip(windows, moves(), strict=True):
        model, xy = model_of(window, move, 1e-3)
        assert joined.add(model, window.start)
    whole = joined.model(model.cameras[1], xy)
    points, views = seen()
    twice = sum(sum(any(q == p for q, _ in v) for v in views) > 1 for p in range(len(points)))
    assert twice <= whole.num_points3D() <= 1.05 * twice  # what leaves the picture and comes back is two points
    adjust_together(whole, xy, np.arange(COUNT) / 10, NO_READOUT)
    assert sorted(whole.reg_image_ids()) == list(range(1, COUNT + 1))
    assert off_by(whole).max() < 0.01
    assert float(np.median(model_errors(whole))) == pytest.approx(0.55, abs=0.1)


def test_windows_that_share_too_little_are_not_joined() -> None:
    joined, first = Joined(), moves()[0]
    assert joined.add(model_of(range(15), first, 1e-3)[0], 0)
    assert not joined.add(model_of(range(20, 35), first, 1e-3)[0], 20)


def test_points_a_pixel_off_have_no_say_in_a_narrow_adjustment() -> None:
    """Most are seen to a twentieth of a pixel, one in six to the right of where it is."""
    model, _ = model_of(range(COUNT), moves()[0], 1e-3)
    (points, views), rng = seen(), np.random.default_rng(3)
    for k, (view, pose) in enumerate(zip(views, path(), strict=True), 1):
        exact, _ = project(points[[p for p, _ in view]] @ pose[:3, :3].T + pose[:3, 3], CAMERA)
        off = np.where(rng.random((len(view), 1)) < 1 / 6, rng.uniform([0.5, 0], [2, 1e-9], (len(view), 2)), 0.0)
        for point, at in zip(model.images[k].points2D, exact + off + rng.normal(0, 0.05, off.shape), strict=True):
            point.xy = at
    errors = []
    for narrowly in (False, True):
        tried = pycolmap.Reconstruction(model)
        adjust_model(tried, refine_camera=False, narrowly=narrowly)
        errors.append(off_by(tried).mean())
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize(("keyframes", "differs"), [(100, False), (750, True)])
def test_memory_makes_only_frames_of_long_recordings_again(keyframes: int, differs: bool, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    CALIBRATION.save(run.stage("frames"), Calibration(CAMERA, "given", 0.0, (0, 0, 0, 0)))
    files = checksums(run.stage("frames"))
    record = StageRecord(Reads(), files, 0, 0, {"keyframes": keyframes}, [], "")
    write_manifest(run.manifest_file, Manifest(Source("", ""), {"frames": record}))
    whole, parts = (frames_division(run, load_config(None, [f"run.memory_mb={mb}"])) for mb in (0, 1100))
    assert (whole != parts) == differs
