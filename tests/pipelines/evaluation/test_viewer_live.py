"""The viewer of a run that is still being made: what it shows after each stage, and what it says is to come."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gaussians import isotropic_cloud
from msgs_slam.formats.ply import write_gaussian_ply
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import BACKBONE, FRAMES, MAP, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.progress import ProgressFile
from msgs_slam.pipelines.system.progress import BEGUN, SilentProgress, StageEvent
from msgs_slam.pipelines.viewer import live
from msgs_slam.pipelines.viewer.live import progress_summary
from msgs_slam.pipelines.viewer.scene import ViewerScene, load_scenes
from tests.browser import BROWSER, browser

OracleRun = Callable[..., RunFolder]


@pytest.fixture
def run(oracle_run: OracleRun) -> RunFolder:
    """A run whose `frames` has left its keyframes and points, of which nothing else is noted as done."""
    made = oracle_run(pixel_stride=8)
    trajectory, found = made.load(TRAJECTORY, "tracking"), made.load(MAP, "mapping")
    rows, none = trajectory.is_keyframe, np.zeros(0, np.int64)
    colors = (255 * found.colors.clamp(0, 1)).byte().numpy()
    model = SparseModel(
        trajectory.frame_ids[rows], trajectory.cam_from_world[rows], found.means.double().numpy(), colors, none, none,
        np.zeros((0, 2)),
    )  # fmt: skip
    BACKBONE.save(made.stage("frames"), model)
    note_finished(made, ())
    return made


def test_each_stage_brings_its_share(run: RunFolder, tmp_path: Path) -> None:
    nothing = load_scenes(run.root)[0]
    assert nothing.is_empty
    assert not nothing.cameras
    assert nothing.opacities.max() < 1e-6
    note_finished(run, STAGES[:2])
    points = load_scenes(run.root)[0]
    assert (points.what, points.is_empty, points.world) == ("points", False, "run")
    model = run.find(BACKBONE)
    assert model is not None
    assert len(points.cameras) == len(model.frame_ids) == 8
    np.testing.assert_allclose(points.cloud.means, model.points_in_world, atol=1e-6)
    np.testing.assert_array_equal(points.colors["colour"], model.colors)
    note_finished(run, STAGES[:3])
    tracked = load_scenes(run.root)[0]
    assert len(tracked.path) == len(run.load(FRAMES))  # every frame has a pose by now
    assert len(tracked.cameras) == 8
    note_finished(run, STAGES[:4])
    assert load_scenes(run.root)[0].what == "Gaussians"
    with pytest.raises(InputError, match="not a run folder"):
        load_scenes(tmp_path)


def test_a_line_says_what_is_shown_and_what_is_to_come(run: RunFolder) -> None:
    note_finished(run, STAGES[:2])
    line = progress_summary(run)
    assert line.startswith(
        "Shown: cameras and points after frames (2 of 6 stages done). Still to come: tracking, mapping"
    )
    assert line.endswith(f"No job is running: `msgs-slam resume {run.root.name}` goes on.")
    with locked(run), ProgressFile(SilentProgress(), run) as progress:
        progress.stage(StageEvent("tracking", 3, 6, BEGUN))
        assert progress_summary(run).endswith("Still to come: tracking (running), mapping, global_ba, export.")
    note_finished(run, STAGES[:4])
    assert "Shown: the map after mapping (4 of 6 stages done). Still to come: global_ba, export." in progress_summary(
        run
    )
    note_finished(run, STAGES)
    assert progress_summary(run) == ""


def test_an_error_of_the_page_does_not_end_the_watch(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(live, "_BETWEEN_LOOKS", 0.02)
    said, shown, followed = [], [], threading.Event()

    def show(scenes: list[ViewerScene]) -> None:
        shown.append(len(scenes))
        if len(shown) == 1:
            raise IndexError("swapped meanwhile")
        followed.set()

    watch = live.RunWatcher(run, said.append, show)
    note_finished(run, STAGES[:2])
    assert followed.wait(60)
    watch.stop()
    assert any("IndexError: swapped meanwhile" in text for text in said)
    assert "cannot be shown as it is now" in caplog.text


def test_a_scene_is_not_swapped_under_a_callback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's threads show a scene while the watch of the run has the next one."""
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer import server

    for count in (20, 300):
        ones = np.ones(count, np.float32)
        means = np.random.default_rng(count).uniform(-1, 1, (count, 3)).astype(np.float32)
        cloud = isotropic_cloud(means, -3 * ones, 4 * ones, np.full((count, 3), 0.5, np.float32))
        write_gaussian_ply(tmp_path / f"{count}.ply", cloud)
    in_callback, swapped, plain_legend = threading.Event(), threading.Event(), server.legend_html

    def slow_legend(scene: ViewerScene) -> str:
        if not in_callback.is_set():
            in_callback.set()
            swapped.wait(1)  # the swap waits, too, where it has to
        return plain_legend(scene)

    viewer = server.open_viewer(tmp_path / "20.ply", port=0)
    try:
        monkeypatch.setattr(server, "legend_html", slow_legend)
        with ThreadPoolExecutor(1) as page:
            shown = page.submit(viewer.show, "colour")
            assert in_callback.wait(60)
            viewer.replace(load_scenes(tmp_path / "300.ply"))
            swapped.set()
            shown.result(60)
        assert len(viewer.scene.cloud) == 300
    finally:
        viewer.stop()


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_follows_the_run(run: RunFolder, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    from msgs_slam.pipelines.viewer.server import open_viewer

    def until(happened: Callable[[], object]) -> None:
        end = time.monotonic() + 120
        while not happened():
            assert time.monotonic() < end, "the page did not answer"
            time.sleep(0.3)

    viewer = open_viewer(run.root, port=0)
    try:
        with browser(tmp_path / "profile") as page:
            page.call("Page.enable")
            page.call("Page.navigate", url=viewer.url)
            text = "document.body.innerText"
            until(lambda: "Shown: nothing yet (0 of 6" in (page.value(text) or ""))
            note_finished(run, STAGES[:2])
            until(lambda: "cameras and points after frames" in page.value(text) and "Show points" in page.value(text))
            points = page.wait_for(lambda p: p.std() > 20)
            page.screenshot(tmp_path / "points.png")
            client = next(iter(viewer.server.get_clients().values()))
            viewer.flight.add(client)
            before = np.asarray(client.camera.position) / viewer.scene.scale
            note_finished(run, STAGES[:4])
            until(lambda: "Show Gaussians" in page.value(text) and "the map after mapping" in page.value(text))
            page.wait_for(lambda p: np.abs(p.astype(float) - points).mean() > 5)
            page.screenshot(tmp_path / "map.png")
            np.testing.assert_allclose(np.asarray(client.camera.position) / viewer.scene.scale, before, atol=1e-4)
            assert len(viewer.flight.keyframes) == 1
    finally:
        viewer.stop()
