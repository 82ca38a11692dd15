"""Camera paths by keyframes: the spline, the file, what `render` draws along it, and the viewer that records it."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished import note_finished
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gaussians import isotropic_cloud
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.ply import write_gaussian_ply
from msgs_slam.pipelines.evaluation.image_quality import psnr
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.world import WORLD, World
from msgs_slam.pipelines.viewer.camera_path import EXPORTED, RUN, SPLATS, CameraPath, Keyframe, read_camera_path
from msgs_slam.pipelines.viewer.render_run import render_file, render_run
from tests.browser import BROWSER, browser

OracleRun = Callable[..., RunFolder]
Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def key(center: tuple[float, float, float], degrees: float = 0.0, fov: float = 50.0) -> Keyframe:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix(), center
    return Keyframe(pose, fov)


SQUARE = (key((0, 0, 0)), key((1, 0, 0), 90, 60), key((1, 0, 1), 100), key((0, 0, 1), 10))


def test_the_flight_goes_through_the_keyframes_without_a_jerk() -> None:
    path = CameraPath(SQUARE, fps=50, seconds_per_keyframe=2.0)
    poses, fovs = path.flight()
    assert len(poses) == path.image_count() == 301
    for i, frame in enumerate(SQUARE):
        np.testing.assert_allclose(poses[100 * i], frame.world_from_cam, atol=1e-9)
        assert fovs[100 * i] == pytest.approx(frame.fov)
    steps = np.diff(poses[:, :3, 3], axis=0)
    # Straight legs would turn by a right angle at the corners: a change of 0.014 from one step to the next.
    assert 0 < np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 1e-3
    # Uniform Catmull-Rom, half way between the inner two: (9 (b + c) - a - d) / 16.
    np.testing.assert_allclose(poses[150, :3, 3], (9 * np.array([2, 0, 1]) - np.array([0, 0, 1])) / 16, atol=1e-9)
    turned = Rotation.from_matrix(poses[50, :3, :3]).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned, (0, 45, 0), atol=1e-9)
    assert fovs[50] == pytest.approx(55)
    two, _ = CameraPath(SQUARE[:2], fps=2, seconds_per_keyframe=1).flight()
    np.testing.assert_allclose(two[:, 0, 3], (0, 0.5, 1), atol=1e-9)


def written(folder: Path, path: CameraPath, **changes: Any) -> Path:
    file = folder / "path.json"
    file.write_text(json.dumps(json.loads(path.to_json()) | changes))
    return file


def test_the_file_holds_all_of_it(tmp_path: Path) -> None:
    path = CameraPath(SQUARE, 24.0, 1.5, RUN)
    again = read_camera_path(written(tmp_path, path))
    assert (again.fps, again.seconds_per_keyframe, again.world) == (24.0, 1.5, RUN)
    for a, b in zip(again.keyframes, SQUARE, strict=True):
        np.testing.assert_allclose(a.world_from_cam, b.world_from_cam, atol=1e-6)
        assert a.fov == b.fov
    assert read_camera_path(tmp_path / "path.json", fps=10.0).image_count() == 46


ROW = json.loads(CameraPath(SQUARE).to_json())["keyframes"][0]


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
    with pytest.raises(InputError, match=said):
        read_camera_path(written(tmp_path, CameraPath(SQUARE), **changes))


def test_a_run_is_drawn_from_the_keyframes_of_either_world(
    oracle_run: OracleRun, truth: Sequence, tmp_path: Path
) -> None:
    run, camera = oracle_run(), truth.camera
    assert camera is not None
    assert truth.world_from_cam is not None
    fov = float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy)))
    keys = tuple(Keyframe(truth.world_from_cam[i], fov) for i in (0, 28))
    file = written(tmp_path, CameraPath(keys, 1.0, 2.0, RUN))
    own = [read_rgb(p) for p in list_images(render_run(run, tmp_path / "own", path=file))]
    assert len(own) == 3
    assert psnr(own[0], truth.rgb(0)) > psnr(own[0], truth.rgb(20)) + 4
    assert 18 < psnr(own[2], truth.rgb(28)) < 45

    exported = written(tmp_path, CameraPath(keys, 1.0, 2.0, EXPORTED))
    with pytest.raises(InputError, match=r"has none: run `msgs-slam resume"):
        render_run(run, tmp_path / "none", path=exported)
    move = Similarity(2.5, Rotation.from_euler("xyz", (20, 30, 40), degrees=True).as_matrix(), np.array([1.0, 2, 3]))
    WORLD.save(run.stage("export"), World("up", "cameras", False, move))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    moved = np.linalg.inv(move.apply_to_poses(np.linalg.inv(truth.world_from_cam[[0, 28]])))
    exported = written(tmp_path, CameraPath(tuple(Keyframe(p, fov) for p in moved), 1.0, 2.0, EXPORTED))
    same = [read_rgb(p) for p in list_images(render_run(run, tmp_path / "same", path=exported, fps=0.5))]
    assert len(same) == 2
    assert np.abs(same[1].astype(float) - own[2]).mean() < 0.5
    turned = tuple(Keyframe(Y_DOWN @ p, fov) for p in moved)  # recorded in the splat file of this run
    splats = written(tmp_path, CameraPath(turned, 1.0, 2.0, SPLATS))
    same = [read_rgb(p) for p in list_images(render_run(run, tmp_path / "splats", path=splats, fps=0.5))]
    assert np.abs(same[1].astype(float) - own[2]).mean() < 0.5
    wide = written(tmp_path, CameraPath(tuple(Keyframe(k.world_from_cam, 1.6 * fov) for k in keys), 1.0, 2.0, RUN))
    assert psnr(read_rgb(list_images(render_run(run, tmp_path / "wide", path=wide))[0]), own[0]) < 20


def test_a_splat_file_is_drawn_along_a_path_and_a_wrong_one_refused_first(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    means = np.concatenate([rng.uniform(-1, 1, (300, 2)), np.full((300, 1), 4.0)], axis=1).astype(np.float32)
    ones = np.ones(300, np.float32)
    write_gaussian_ply(tmp_path / "s.ply", isotropic_cloud(means, -2 * ones, 3 * ones, np.ones((300, 3), np.float32)))
    away = written(tmp_path, CameraPath((key((0, 0, 0)), key((0, 0, 0), 120)), 1.0, 1.0))
    images = [
        read_rgb(p) for p in list_images(render_file(tmp_path / "s.ply", tmp_path / "o", path=away, size=(64, 48)))
    ]
    assert [image.mean() > 5 for image in images] == [True, False]  # the wall ahead, then nothing
    WORLD.save(tmp_path, World("up", "floor", True, Similarity(1.0, np.eye(3), np.zeros(3))))
    for world, turn in ((SPLATS, np.eye(4)), (EXPORTED, Y_DOWN.T)):
        keys = tuple(Keyframe(turn @ k.world_from_cam, k.fov) for k in (key((0, 0, 0)), key((0, 0, 0), 120)))
        path = written(tmp_path, CameraPath(keys, 1.0, 1.0, world))
        files = list_images(render_file(tmp_path / "s.ply", tmp_path / "o", path=path, size=(64, 48)))
        assert all(np.array_equal(read_rgb(file), image) for file, image in zip(files, images, strict=True))
    with pytest.raises(InputError, match="give the run instead"):
        render_file(tmp_path / "s.ply", tmp_path / "x", path=written(tmp_path, CameraPath(SQUARE, world=RUN)))
    with pytest.raises(InputError, match="there is no file 'orbot'"):
        render_file(tmp_path / "missing.ply", tmp_path / "x", path="orbot")
    assert not (tmp_path / "x").exists()


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_records_plays_and_saves_a_path(oracle_run: OracleRun, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer.server import open_viewer

    viewer = open_viewer(oracle_run(pixel_stride=8).root, port=0)
    flight, cameras = viewer.flight, viewer.scene.cameras

    def until(happened: Callable[[], object]) -> None:
        end = time.monotonic() + 120
        while not happened():
            assert time.monotonic() < end, "the page did not answer"
            time.sleep(0.3)

    try:
        with browser(tmp_path / "profile") as page:
            page.call("Page.enable")
            page.call("Page.navigate", url=viewer.url)
            page.wait_for(lambda p: p.std() > 20 and (p < 240).mean() > 0.3)
            client = next(iter(viewer.server.get_clients().values()))
            downloads = tmp_path / "downloads"
            page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))
            for count, camera in enumerate((cameras[0], cameras[4], cameras[2], cameras[7]), 1):
                viewer.visit(camera, client)
                time.sleep(1)  # the page tells where it looks from
                page.press("Add keyframe")
                until(lambda count=count: len(flight.keyframes) == count)
            flight.chosen.value = "3"
            page.press("Delete keyframe")
            until(lambda: len(flight.keyframes) == 3)
            flight.seconds.value = 0.5
            page.press("Play")
            until(lambda: flight.play_button.label == "Stop")
            until(lambda: flight.play_button.label == "Play")
            before, end = (cameras[n].world_from_cam[:3, 3] * viewer.scene.scale for n in (4, 7))
            # What a busy page tells last may be from shortly before the end.
            until(lambda: np.linalg.norm(client.camera.position - end) < 0.25 * np.linalg.norm(before - end))
            page.press("Download (.json)")
            until(lambda: list(downloads.glob("*-path.json")))
            page.screenshot(tmp_path / "path.png")
    finally:
        viewer.stop()
    saved = read_camera_path(next(downloads.glob("*-path.json")))
    assert (saved.world, saved.seconds_per_keyframe) == (RUN, 0.5)
    for found, camera in zip(saved.keyframes, (cameras[0], cameras[4], cameras[7]), strict=True):
        np.testing.assert_allclose(found.world_from_cam, camera.world_from_cam, atol=2e-3)
        assert found.fov == pytest.approx(np.degrees(camera.fov), abs=0.1)
