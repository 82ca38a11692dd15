"""Films and pictures of a finished map, and the paths that they go along."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished import note_finished
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.formats.video import VideoReader
from msgs_slam.pipelines.evaluation.film import (
    KINDS,
    CameraPath,
    film_seconds,
    orbit,
    read_camera_path,
    render_run,
    resampled,
    smoothed,
)
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.export.web_page import EXPORTED, RUN
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD, World, cameras_up
from tests.world import make_world, walk

OracleRun = Callable[..., RunFolder]


def test_own_path_in_colour_shows_the_frames(oracle_run: OracleRun, truth: Dataset, tmp_path: Path) -> None:
    folder = render_run(oracle_run(), tmp_path / "pictures", kind="color", path="own", fps=1.6)
    pictures = [read_rgb(p) for p in list_images(folder)]
    assert len(pictures) == 5
    # Frames 0 and 31 are the ends of the path; 0 is a keyframe.
    assert 18 < psnr(pictures[0], truth.rgb(0)) < 45
    assert psnr(pictures[0], truth.rgb(0)) > psnr(pictures[0], truth.rgb(20)) + 4


def test_a_rendering_replaces_an_earlier_one_and_no_photographs(oracle_run: OracleRun, tmp_path: Path) -> None:
    run, folder, photos = oracle_run(), tmp_path / "pictures", tmp_path / "photos"
    for fps, count in ((1.6, 5), (1.6, 5), (1.0, 3)):
        assert len(list_images(render_run(run, folder, path="own", fps=fps, size=(32, 24)))) == count
    write_rgb(photos / "000001.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "film.mp4").write_bytes(b"precious")
    for target in (photos, tmp_path / "film.mp4"):
        with pytest.raises(InputError, match=r"which msgs-slam has not written.*--overwrite"):
            render_run(run, target, path="own", fps=1.0, size=(32, 24))
    assert [p.name for p in list_images(photos)] == ["000001.png"]
    assert (tmp_path / "film.mp4").read_bytes() == b"precious"
    render_run(run, photos, path="own", fps=1.0, size=(32, 24), overwrite=True)
    assert len(list_images(photos)) == 3


def test_a_video_whose_name_has_no_suffix_is_no_folder(oracle_run: OracleRun, tmp_path: Path) -> None:
    run, clip = oracle_run(), tmp_path / "clip"
    for there, is_folder in ((lambda: None, True), (lambda: clip.write_bytes(b"video"), False)):
        there()  # what is gone is judged by its name
        write_manifest(run.manifest_file, Manifest(Source(str(clip), ""), run.records))
        assert load_outcome(RunFolder(run.root)).source_is_folder is is_folder


@pytest.mark.parametrize(
    ("count", "apart", "seconds"), [(32, 0.2, 6.2), (32, 300.0, 31), (11, 3e7, 10), (320, 90.0, 60), (3000, 0.1, 299.9)]
)
def test_photos_are_a_second_of_film_each_and_a_minute_in_all(count: int, apart: float, seconds: float) -> None:
    assert film_seconds(np.arange(count) * apart) == pytest.approx(seconds)


def test_the_length_of_a_film_is_said_first(
    oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    outcome, told = load_outcome(run), list[str]()
    walk = replace(outcome.trajectory, timestamps=np.arange(32) * 300.0)
    monkeypatch.setattr("msgs_slam.pipelines.evaluation.film.load_outcome", lambda _: replace(outcome, trajectory=walk))
    folder = render_run(run, tmp_path / "film", path="own", fps=0.2, size=(24, 18), tell=told.append)
    assert len(list_images(folder)) == 6  # of 31 seconds, not of 9,300
    assert told == ["rendering 6 images: a film of 30 s at 0.2 images a second"]


@pytest.mark.parametrize("name", ["out.gif", "out.mov", "OUT.WEBM", "out.mpg4"])
def test_suffixes_that_cannot_be_written_are_refused_before_the_work(
    name: str, oracle_run: OracleRun, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"cannot be written as .*\.mp4, \.avi, \.mkv, or a folder"):
        render_run(oracle_run(), tmp_path / name)
    assert not (tmp_path / name).exists()


def test_videos_of_an_orbit_in_each_kind(oracle_run: OracleRun, tmp_path: Path) -> None:
    run, firsts = oracle_run(), []
    for kind in KINDS:
        frames = [
            f.rgb.astype(float) for f in VideoReader(render_run(run, tmp_path / f"{kind}.mp4", kind, "orbit", 0.4))
        ]
        assert [frame.shape for frame in frames] == 4 * [(180, 240, 3)]
        assert np.abs(frames[0] - frames[1]).mean() > 5
        firsts.append(frames[0])
    assert all(np.abs(a - b).mean() > 5 for a, b in combinations(firsts, 2))


def test_unknown_kinds_and_runs_without_a_map_are_refused(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run()
    with pytest.raises(InputError, match="kind is one of"):
        render_run(run, tmp_path / "x", kind="colour")
    with pytest.raises(InputError, match="path is one of"):
        render_run(run, tmp_path / "x", path="helix")
    (tmp_path / "taken.txt").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        render_run(run, tmp_path / "taken.txt")
    note_finished(run, ("frames", "proxy", "tracking"))
    with pytest.raises(InputError, match="no map yet"):
        render_run(run, tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.fixture(scope="module")
def room_walk() -> NDArray:
    return walk(make_world(texel=0.2), np.linspace(0, 0.6, 40))


def require_rigid(path: NDArray) -> None:
    products = path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1, atol=1e-9)


def test_resampling_keeps_the_given_poses_and_goes_between(room_walk: NDArray) -> None:
    dense = resampled(room_walk, 79)
    require_rigid(dense)
    np.testing.assert_allclose(dense[::2], room_walk, atol=1e-9)
    middle = (room_walk[0, :3, 3] + room_walk[1, :3, 3]) / 2
    np.testing.assert_allclose(dense[1, :3, 3], middle, atol=1e-12)
    assert resampled(room_walk[:1], 5).shape == (5, 4, 4)


def test_smoothing_takes_tremble_out_and_leaves_the_walk(room_walk: NDArray) -> None:
    rng = np.random.default_rng(0)
    shaken = room_walk.copy()
    shaken[:, :3, 3] += rng.normal(scale=0.02, size=(40, 3))
    shaken[:, :3, :3] = shaken[:, :3, :3] @ Rotation.from_rotvec(rng.normal(scale=0.02, size=(40, 3))).as_matrix()
    calm = smoothed(shaken, 2.0)
    require_rigid(calm)

    def roughness(path: NDArray) -> float:
        return float(np.abs(np.diff(path[:, :3], n=2, axis=0)).mean())

    assert roughness(calm) < 0.3 * roughness(shaken)
    inner = np.linalg.norm(calm[5:-5, :3, 3] - room_walk[5:-5, :3, 3], axis=1)
    assert 0 < inner.max() < 0.1


def ring(degrees: NDArray) -> NDArray:
    """Cameras around the origin, 2 away and looking at it; z is up."""
    poses = np.tile(np.eye(4), (len(degrees), 1, 1))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, one = np.zeros_like(c), np.ones_like(c)
    axes = ((-s, c, zero), (zero, zero, -one), (-c, -s, zero))
    poses[:, :3, :3] = np.stack([np.stack(axis, axis=1) for axis in axes], axis=2)
    poses[:, :2, 3] = 2 * np.stack([c, s], axis=1)
    return poses


@pytest.mark.parametrize(("first", "last"), [(150, 230), (-40, 60), (0, 350)])
def test_an_orbit_stays_where_the_cameras_looked_from(first: int, last: int) -> None:
    path = orbit(ring(np.linspace(first, last, 30)), 2.0, 60, np.array([0.0, 0, 1]))
    require_rigid(path)
    np.testing.assert_allclose(np.linalg.norm(path[:, :3, 3], axis=1), 2, atol=1e-6)
    middle = np.radians((first + last) / 2)
    angle = np.degrees(np.angle(np.exp(1j * (np.arctan2(path[:, 1, 3], path[:, 0, 3]) - middle))))
    step = np.abs(np.diff(np.unwrap(np.radians(angle)), append=np.radians(angle[0])))
    if last - first == 350:
        assert np.ptp(angle) > 350
    else:
        np.testing.assert_allclose([angle.min(), angle.max()], [(first - last) / 2, (last - first) / 2], atol=0.5)
        assert step.max() < np.radians(8)  # back again, without a jump


def test_cameras_that_look_apart_still_have_an_orbit() -> None:
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 10)  # side by side, parallel: no common point
    path = orbit(poses, 3.0, 12, cameras_up(poses))
    require_rigid(path)
    assert np.isfinite(path).all()
    np.testing.assert_allclose(path[:, 2, 3], 0, atol=0.1)  # where they stood, and as they looked
    assert (path[:, 2, 2] > 0.95).all()


def key(center: tuple[float, float, float], degrees: float = 0.0) -> NDArray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix(), center
    return pose


SQUARE = np.stack([key((0, 0, 0)), key((1, 0, 0), 90), key((1, 0, 1), 100), key((0, 0, 1), 10)])
FOVS = np.array([50.0, 60, 50, 50])


def test_the_flight_goes_through_the_keyframes_without_a_jerk() -> None:
    poses, fovs = CameraPath(SQUARE, FOVS, fps=50, seconds_per_keyframe=2.0, world=RUN).flight()
    assert len(poses) == 301
    np.testing.assert_allclose(poses[::100], SQUARE, atol=1e-9)
    np.testing.assert_allclose(fovs[::100], FOVS)
    steps = np.diff(poses[:, :3, 3], axis=0)
    # Straight legs would turn by a right angle at the corners: a change of 0.014 from one step to the next.
    assert 0 < np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 1e-3
    # Uniform Catmull-Rom, half way between the inner two: (9 (b + c) - a - d) / 16.
    np.testing.assert_allclose(poses[150, :3, 3], (9 * np.array([2, 0, 1]) - np.array([0, 0, 1])) / 16, atol=1e-9)
    turned = Rotation.from_matrix(poses[50, :3, :3]).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned, (0, 45, 0), atol=1e-9)
    assert fovs[50] == pytest.approx(55)
    two, _ = CameraPath(SQUARE[:2], FOVS[:2], 2, 1, RUN).flight()
    np.testing.assert_allclose(two[:, 0, 3], (0, 0.5, 1), atol=1e-9)


def as_json(world_from_cam: NDArray, fovs: NDArray, world: str, changes: dict[str, Any] | None = None) -> str:
    """What the page saves."""
    quaternions = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]].tolist()
    values = zip(world_from_cam[:, :3, 3].tolist(), quaternions, fovs.tolist(), strict=True)
    rows = [dict(zip(("position", "rotation_wxyz", "fov_degrees"), row, strict=True)) for row in values]
    about = {"format": "msgs-slam camera path 1", "world": world, "fps": 1.0, "seconds_per_keyframe": 2.0}
    return json.dumps(about | {"keyframes": rows} | (changes or {}))


def test_the_file_holds_all_of_it(tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(as_json(SQUARE, FOVS, RUN, {"fps": 24.0, "seconds_per_keyframe": 1.5}))
    again = read_camera_path(tmp_path / "path.json")
    assert (again.fps, again.seconds_per_keyframe, again.world) == (24.0, 1.5, RUN)
    np.testing.assert_allclose(again.world_from_cam, SQUARE, atol=1e-9)
    np.testing.assert_allclose(again.fovs, FOVS)
    assert read_camera_path(tmp_path / "path.json", fps=10.0).image_count == 46


ROW = json.loads(as_json(SQUARE, FOVS, RUN))["keyframes"][0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "nerfstudio"}, "no camera path"),
        ({"world": "mars"}, "world is 'mars'"),
        ({"keyframes": [ROW]}, "1 keyframes, expected 2"),
        ({"keyframes": {}}, "no list of keyframes"),
        ({"keyframes": [ROW, 7]}, "keyframe 2 is '7'"),
        ({"keyframes": [ROW, ROW | {"position": [0, 1]}]}, "keyframe 2: position is .* expected 3 numbers"),
        ({"keyframes": [ROW, ROW | {"rotation_wxyz": [0, 0, 0, 0]}]}, "keyframe 2: rotation_wxyz is no unit"),
        ({"keyframes": [ROW | {"fov_degrees": 180}, ROW]}, "keyframe 1: fov_degrees is 180, expected 1 to 170"),
        ({"fps": 0}, "fps is 0, expected 0.1 to 240"),
        ({"fps": "fast"}, "'fps' is 'fast'"),
        ({"seconds_per_keyframe": None}, "lacks 'seconds_per_keyframe'"),
        ({"fps": 240, "seconds_per_keyframe": 600}, "at most 100,000"),
    ],
)
def test_bad_files_are_refused_with_the_entry(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    (tmp_path / "path.json").write_text(as_json(SQUARE, FOVS, EXPORTED, changes))
    with pytest.raises(InputError, match=said):
        read_camera_path(tmp_path / "path.json")


def test_a_run_is_drawn_from_the_keyframes_of_either_world(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path
) -> None:
    run, camera, file = oracle_run(), truth.camera, tmp_path / "path.json"
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))
    poses, fovs = truth.world_from_cam[[0, 28]], np.array([fov, fov])

    def drawn(poses: NDArray, fovs: NDArray, world: str, fps: float | None = None) -> list[NDArray[np.uint8]]:
        file.write_text(as_json(poses, fovs, world))
        return [read_rgb(p) for p in list_images(render_run(run, tmp_path / "out", path=file, fps=fps))]

    own = drawn(poses, fovs, RUN)
    assert len(own) == 3
    assert psnr(own[0], truth.rgb(0)) > psnr(own[0], truth.rgb(20)) + 4
    assert 18 < psnr(own[2], truth.rgb(28)) < 45
    assert psnr(drawn(poses, 1.6 * fovs, RUN)[0], own[0]) < 20
    with pytest.raises(InputError, match=r"has none: run `msgs-slam resume"):
        drawn(poses, fovs, EXPORTED)
    move = Similarity(2.5, Rotation.from_euler("xyz", (20, 30, 40), degrees=True).as_matrix(), np.array([1.0, 2, 3]))
    WORLD.save(run.stage("export"), World("up", "cameras", False, move))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    same = drawn(np.linalg.inv(move.apply_to_poses(np.linalg.inv(poses))), fovs, EXPORTED, 0.5)
    assert len(same) == 2
    assert np.abs(same[1].astype(float) - own[2]).mean() < 0.5
