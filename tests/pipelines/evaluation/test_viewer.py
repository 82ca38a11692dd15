"""The viewer's scene as arrays, and the viewer itself in a real browser."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from finished import note_finished
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.ply import read_gaussian_ply
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.viewer.scene import load_scenes
from msgs_slam.pipelines.viewer.tools import round_range
from tests.browser import BROWSER, Page, browser, button

OracleRun = Callable[..., RunFolder]


def test_scene_of_a_run(oracle_run: OracleRun) -> None:
    scene = load_scenes(oracle_run().root)[0]
    m = len(scene.centers)
    assert scene.covariances.shape == (m, 3, 3)
    assert set(scene.colors) == {"colour", "classes"}
    assert all(c.shape == (m, 3) and c.dtype == np.uint8 for c in scene.colors.values())
    assert len(scene.cameras) == 8
    # Half precision keeps ten bits above 6e-5; smaller covariances would fade.
    assert np.median(scene.covariances[:, 0, 0]) > 6e-5
    assert 4 < np.ptp(np.quantile(scene.centers, (0.05, 0.95), axis=0), axis=0).max() < 7
    np.testing.assert_allclose(scene.up, (0, 0, 1), atol=0.1)  # the world's z axis


def test_depth_is_seen_from_the_camera(oracle_run: OracleRun) -> None:
    scene = load_scenes(oracle_run().root)[0]
    camera = scene.cameras[0].world_from_cam
    position, forward = camera[:3, 3] * scene.scale, camera[:3, 2]
    depth = (scene.centers - position) @ forward
    colors = scene.depth_colors(position, forward).astype(int)
    order = np.argsort(depth)
    near, far = colors[order[depth[order] > 0][:50]].mean(axis=0), colors[order[-50:]].mean(axis=0)
    assert near[0] > near[2]  # red before blue
    assert far[2] > far[0]
    equal = np.abs(depth - np.median(depth)) < 1e-3
    assert equal.sum() > 3
    assert np.ptp(colors[equal], axis=0).max() <= 12  # one depth, one colour, however far to the side


def test_scene_of_a_splat_file_by_another_program(shared_data: Path) -> None:
    folder = shared_data / "format_cases"
    path = folder / "ply_other_writers" / "test-splat.3-points-from-train.ply"
    (scene,), cloud = load_scenes(path), read_gaussian_ply(path)
    assert len(scene.centers) == 3
    # The covariance's eigenvalues are the squared scales, however it is turned.
    expected = np.sort(np.exp(2 * cloud.log_scales), axis=1) * scene.scale**2
    np.testing.assert_allclose(np.linalg.eigvalsh(scene.covariances), expected, rtol=1e-3, atol=1e-9)
    with pytest.raises(InputError, match="LFS"):
        load_scenes(folder / "lfs_pointer" / "point_cloud.ply")


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such run"):
        load_scenes(tmp_path / "nowhere")
    with pytest.raises(InputError):
        load_scenes(tmp_path)


def test_sliders_have_few_digits() -> None:
    assert round_range(-1.039511, 1.40123) == (-1.04, 1.41, 0.01)
    assert round_range(-53.2, 118.9) == (-54.0, 119.0, 1.0)
    assert round_range(0.00231, 0.00872) == (0.0023, 0.0088, 0.0001)


# in the browser -------------------------------------------------------------------------------------------------


def where_shown(point: NDArray[np.float64], camera: Any, size: tuple[float, float]) -> tuple[float, float]:
    """Pixel of a point of the scene in the page."""
    turn = Rotation.from_quat(np.asarray(camera.wxyz)[[1, 2, 3, 0]]).as_matrix()
    x, y, z = turn.T @ (point - camera.position)
    focal = size[1] / 2 / np.tan(camera.fov / 2)
    return size[0] / 2 + focal * x / z, size[1] / 2 + focal * y / z


def changes(page: Page, before: NDArray[np.uint8], by: float = 10) -> NDArray[np.uint8]:
    """Wait until the picture differs, and until it is one at all."""
    after = page.wait_for(lambda p: np.abs(p.astype(float) - before).mean() > by)
    assert after.std() > 20
    return after


def until(happened: Callable[[], object]) -> None:
    end = time.monotonic() + 120
    while not happened():
        assert time.monotonic() < end, "the page did not answer"
        time.sleep(0.5)


def measure(page: Page, viewer: Any, truth: Sequence) -> tuple[float, float]:
    """What the tape says after a click and a press on its button in the first camera's view, and the true distance."""
    client = next(iter(viewer.server.get_clients().values()))
    width, height = page.canvas()
    focal, camera, depth = height / 2 / np.tan(client.camera.fov / 2), truth.camera, truth.depth(0)
    assert camera is not None
    assert depth is not None
    places = []
    viewer.tape.switch.value = True
    time.sleep(1)
    for x in (0.45, 0.5):
        ray = np.array([(x - 0.5) * width / focal, 0.0, 1.0])
        u, v = int(camera.fx * ray[0] + camera.cx), int(camera.cy)
        places.append(depth[v, u] * ray)
    page.click(0.45 * width, 0.5 * height)
    until(lambda: viewer.tape.told.content.startswith("Click the second place."))
    page.press("Mark the middle")
    until(lambda: viewer.tape.result)
    return float(viewer.tape.result.split()[0]), float(np.linalg.norm(places[1] - places[0]))


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_page_shows_the_map_and_every_control_changes_it(
    oracle_run: OracleRun, truth: Sequence, tmp_path: Path
) -> None:
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer.server import open_viewer

    # A browser without a GPU draws few Gaussians at a speed that a test can wait for.
    run = oracle_run(metric=False, pixel_stride=8, mesh=True)
    box = trimesh.creation.box((30, 30, 0.1))
    box.visual.vertex_colors = np.tile([250, 240, 20, 255], (len(box.vertices), 1))
    box.export(run.stage("export") / "mesh.ply")
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    viewer = open_viewer(run.root, port=0)
    try:
        with browser(tmp_path / "profile") as page:
            page.call("Page.enable")
            page.call("Page.navigate", url=viewer.url)
            colour = page.wait_for(lambda p: p.std() > 20 and (p < 240).mean() > 0.3)
            viewer.mode.value = "classes"
            classes = changes(page, colour)
            assert viewer.legend.visible
            assert viewer.legend.content.count("background:rgb(") == len(np.unique(viewer.scene.labels))
            viewer.mode.value = "depth"
            depth = changes(page, classes)
            assert not viewer.legend.visible
            first = viewer.scene.cameras[0]
            client = next(iter(viewer.server.get_clients().values()))
            page.click(*where_shown(first.world_from_cam[:3, 3] * viewer.scene.scale, client.camera, page.canvas()))
            elsewhere = changes(page, depth)
            assert viewer.preview.label.startswith(first.frame.name)
            page.press("Reset view")
            changes(page, elsewhere)
            viewer.visit(first, client)
            page.wait_for(lambda p: np.abs(p.astype(float) - elsewhere).mean() < 3)
            measured, true = measure(page, viewer, truth)
            assert 0 < abs(measured - true) < 0.1 * true
            viewer.tape.kind.value = "area"
            time.sleep(1)
            width, height = page.canvas()
            for x, y in ((0.45, 0.5), (0.5, 0.5), (0.5, 0.6)):
                page.click(x * width, y * height)
                time.sleep(2)
            until(lambda: viewer.tape.result.endswith("square units"))
            viewer.tape.switch.value = False
            assert not viewer.tape.told.content
            shown = int(viewer.selection.rows.sum())
            page.press("Delete visible Gaussians")
            until(lambda: not viewer.selection.rows.any())
            time.sleep(3)  # the button comes with the answer
            page.press("Undo delete")
            until(lambda: int(viewer.selection.rows.sum()) == shown)
            viewer.boxes["Show Gaussians"].value = False
            bare = page.wait_for(lambda p: np.abs(p.astype(float) - elsewhere).mean() > 10)
            viewer.boxes["Mesh"].value = True
            page.wait_for(lambda p: np.abs(p.astype(float) - bare).mean() > 10)
    finally:
        viewer.stop()


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_fingers_on_a_phone_fold_measure_turn_and_choose_a_camera(oracle_run: OracleRun, tmp_path: Path) -> None:
    """viser takes no tap on the scene for a click, so the tape has a button."""
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer.server import open_viewer

    viewer = open_viewer(oracle_run(metric=False, pixel_stride=8).root, port=0)
    fold = """[...document.querySelectorAll("p, div")].findLast(e => e.innerText == "MSGS-SLAM walk.msgs")"""
    try:
        with browser(tmp_path / "profile") as page:
            page.be_a_phone()
            page.call("Page.enable")
            page.call("Page.navigate", url=viewer.url)
            page.wait_for(lambda p: p.std() > 20)
            viewer.tape.switch.value = True
            for told in ("Click the second place.", "±"):
                until(lambda: page.tap(button("Mark the middle")))
                until(lambda told=told: told in viewer.tape.told.content)
                page.fingers([(40 + 6 * n, 250) for n in range(8)])
                time.sleep(2)
            viewer.tape.switch.value = False
            page.tap(fold)
            until(lambda: not page.tap(button("Reset view")))
            client, first = next(iter(viewer.server.get_clients().values())), viewer.scene.cameras[0]
            viewer.visit(viewer.scene.cameras[-1], client)
            time.sleep(3)
            page.fingers([where_shown(first.world_from_cam[:3, 3] * viewer.scene.scale, client.camera, page.canvas())])
            until(lambda: viewer.preview.label.startswith(first.frame.name))
    finally:
        viewer.stop()
