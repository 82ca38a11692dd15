"""The page of a run as it is served: to whom, what of the run, and how it follows a run that is being made."""

import http.client
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.evaluation.film import read_camera_path, render_run
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.evaluation.serve import PageServer, page_of_run, progress_summary
from msgs_slam.pipelines.evaluation.views import render_outcome
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import BACKBONE, MAP, SPARSE, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.progress import ProgressFile
from msgs_slam.pipelines.system.progress import BEGUN, SilentProgress, StageEvent
from tests.browser import BROWSER, browser

OracleRun = Callable[..., RunFolder]


@pytest.fixture
def run(oracle_run: OracleRun) -> RunFolder:
    """A run whose stages have left keyframes, points and a map, and of which nothing is noted as done."""
    made = oracle_run(pixel_stride=8)
    trajectory, found = made.load(TRAJECTORY, "tracking"), made.load(MAP, "mapping")
    rows, none = trajectory.is_keyframe, np.zeros(0, np.int64)
    colors = (255 * found.colors.clamp(0, 1)).byte().numpy()
    model = SparseModel(
        trajectory.frame_ids[rows], trajectory.cam_from_world[rows], found.means.double().numpy(), colors, none, none,
        np.zeros((0, 2)),
    )  # fmt: skip
    BACKBONE.save(made.stage("frames"), model)
    SPARSE.save(made.stage("tracking"), model)
    note_finished(made, ())
    return made


@contextmanager
def served(run: RunFolder) -> Iterator[PageServer]:
    with PageServer(run) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(server: PageServer, path: str, *hosts: str, method: str = "GET") -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.putrequest(method, path, skip_host=True)
    for host in hosts or (f"127.0.0.1:{server.server_port}",):
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def about(page: str) -> dict:
    return json.loads(re.search(r'id="about">(.*?)</script>', page, re.DOTALL)[1])


def test_only_this_machine_is_answered_and_nothing_but_the_pages(run: RunFolder) -> None:
    (run.root / "secret.txt").write_text("secret")
    with served(run) as server:
        assert server.url == f"http://127.0.0.1:{server.server_port}/"
        assert server.socket.getsockname()[0] == "127.0.0.1"
        for host in ("127.0.0.1", "localhost", "LOCALHOST:8080", f"127.0.0.1:{server.server_port}"):
            assert ask(server, "/", host)[0] == 200
        for hosts in (
            ("evil.example",), ("127.0.0.1.evil.example",), ("127.0.0.1@evil.example",), ("evil.example:80",), ("",),
            ("[::1",), ("127.0.0.1", "evil.example"), ("0.0.0.0",),
        ):  # fmt: skip
            for path in ("/", "/state", "/map"):
                assert ask(server, path, *hosts)[0] == 403
        for path in (
            "/manifest.json", "/secret.txt", "/../secret.txt", "/map/../secret.txt", "/%2e%2e/%2e%2e/etc/passwd",
            "//etc/passwd", "/..%5c..%5cetc/passwd", "/piece_2", "/map/", "/frames/000000.png", "/export/map.html",
        ):  # fmt: skip
            status, text = ask(server, path)
            assert (status, "secret" in text) == (404, False), path
        assert ask(server, "/map", method="POST")[0] == 501
        with pytest.raises(InputError, match="choose another with --port"):
            PageServer(run, server.server_port)


def test_each_stage_brings_its_share(run: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to show yet"):
        page_of_run(run)
    points = len(BACKBONE.read(run.stage("frames") / BACKBONE.name).points_in_world)
    with served(run) as server:
        assert "nothing to show yet" in ask(server, "/map")[1]
        versions = [json.loads(ask(server, "/state")[1])["parts"]["map"]]
        for count, elements, cameras in ((2, "points", 8), (3, "points", 32), (4, "Gaussians", 32)):
            note_finished(run, STAGES[:count])
            found = about(ask(server, "/map")[1])
            assert (found["elements"], len(found["cameras"]), found["recorded"]["world"]) == (elements, cameras, "run")
            assert found["count"] == points
            forward = np.array([camera["r"] for camera in found["cameras"]]).reshape(-1, 3, 3)
            assert (forward[:, 1, 2] < -0.8).all()  # down is against the page's z
            versions.append(json.loads(ask(server, "/state")[1])["parts"]["map"])
        assert len(set(versions)) == 4
        run.stage("export").mkdir()
        (run.stage("export") / "map.html").write_text("the exported page")
        note_finished(run, (*STAGES[:4], "export"))
        assert ask(server, "/map") == (200, "the exported page")
        (run.stage("export") / "map.html").write_text("of somebody else!")
    with pytest.raises(InputError, match=r"map\.html is .*msgs-slam resume"):
        page_of_run(run)
    with pytest.raises(InputError, match="not a run folder"):
        PageServer(RunFolder(tmp_path))


def test_a_line_says_what_is_shown_and_what_is_to_come(run: RunFolder) -> None:
    note_finished(run, STAGES[:2])
    line = progress_summary(run)
    assert line.startswith(
        "Shown: cameras and points after frames (2 of 6 stages done). Still to come: tracking, mapping"
    )
    assert line.endswith(f"No job is running: `msgs-slam resume {run.root.name}` continues.")
    with locked(run), ProgressFile(SilentProgress(), run) as progress:
        progress.stage(StageEvent("tracking", 3, 6, BEGUN))
        assert progress_summary(run).endswith("Still to come: tracking (running), mapping, global_ba, export.")
    note_finished(run, STAGES[:4])
    assert "Shown: the map after mapping (4 of 6 stages done). Still to come: global_ba, export." in progress_summary(
        run
    )
    note_finished(run, STAGES)
    assert progress_summary(run) == ""


IN_MAP = "document.getElementById('map').contentDocument"
KEY = f"{IN_MAP}.defaultView.dispatchEvent(new KeyboardEvent({{!r}}, {{{{key: {{!r}}}}}}))"


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_the_page_follows_the_run_and_records_a_path(run: RunFolder, tmp_path: Path) -> None:
    downloads = tmp_path / "downloads"
    with served(run) as server, browser(tmp_path / "profile", (900, 700)) as page:
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))
        page.call("Page.navigate", url=server.url)
        page.until(lambda: "Shown: nothing yet (0 of 6" in (page.value("document.body.innerText") or ""))
        note_finished(run, STAGES[:3])
        page.until(lambda: " points." in (page.value(f"{IN_MAP}.body.innerText") or ""))
        page.until(lambda: page.value(f"{IN_MAP}.documentElement.dataset.ready"))
        page.screenshot(tmp_path / "points.png")
        page.value(f"{IN_MAP}.getElementById('keep').click()")
        for key in "wd":
            before = page.scene()
            page.value(KEY.format("keydown", key))
            page.wait_for_change(before)
            page.value(KEY.format("keyup", key))
        page.value(f"{IN_MAP}.getElementById('keep').click()")
        note_finished(run, STAGES[:4])
        page.until(lambda: " Gaussians." in (page.value(f"{IN_MAP}.body.innerText") or ""))
        page.until(lambda: page.value(f"{IN_MAP}.documentElement.dataset.ready"))
        page.screenshot(tmp_path / "map.png")
        page.value(f"{IN_MAP}.getElementById('save').click()")
        page.until(lambda: list(downloads.glob("*-path.json")))
    found, t = read_camera_path(next(downloads.glob("*-path.json"))), load_outcome(run).trajectory
    begun = found.world_from_cam[0]  # at one of the cameras, kept over the reload
    nearest = int(np.linalg.norm(t.world_from_cam[:, :3, 3] - begun[:3, 3], axis=1).argmin())
    np.testing.assert_allclose(begun, t.world_from_cam[nearest], atol=0.02)  # levelled
    moved = found.world_from_cam[1, :3, 3] - begun[:3, 3]
    assert moved @ begun[:3, 2] > 0.1  # ahead
    assert moved @ begun[:3, 0] > 0.1  # and to the right
    first = read_rgb(list_images(render_run(run, tmp_path / "out", path=next(downloads.glob("*.json")), fps=1.0))[0])
    assert psnr(first, render_outcome(load_outcome(run), np.linalg.inv(begun)).exposed(None, 0.0)) > 30
