"""The report is whole, self-contained, escapes what it is given, and its advice follows the capture."""

import base64
import json
import re
import time
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.glb import ClassMesh, write_mesh_glb
from msgs_slam.formats.images import decode_rgb
from msgs_slam.pipelines.evaluation.facts import Capture, advice, found_lengths, lost_stretches
from msgs_slam.pipelines.evaluation.html import Line, page, plot, section, table, ticks
from msgs_slam.pipelines.evaluation.report import truth_section, write_report
from msgs_slam.pipelines.evaluation.write import JUDGED, PATH_FROM_ABOVE, write_evaluation
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import FRAMES, LEFT_OUT, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import read_manifest, write_manifest
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import SAME, WORLD, World
from msgs_slam.pipelines.types import LoopEdge
from tests.browser import BROWSER, browser

OracleRun = Callable[..., RunFolder]
VOID_TAGS = {"img", "meta", "rect", "line", "path", "circle"}


class Balanced(HTMLParser):
    """Fails on a tag that is closed but was not opened, or the other way round."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images, self.text = 0, ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"
        self.open += [] if tag in VOID_TAGS else [tag]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_report_is_whole_and_needs_nothing_from_outside(oracle_run: OracleRun, truth: Dataset) -> None:
    run = oracle_run()
    write_evaluation(run, truth, max_views=1)
    svg = '<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)"><script>alert(1)</script></svg>'
    run.evaluation_file.with_name(PATH_FROM_ABOVE).write_text(svg)
    classes = json.loads((run.stage("proxy") / "classes.json").read_text())
    classes[0]["name"] = "<script>alert(1)</script>"
    (run.stage("proxy") / "classes.json").write_text(json.dumps(classes))
    run.stage("export").mkdir(exist_ok=True)
    WORLD.save(run.stage("export"), World("up", "floor", True, SAME))
    (run.stage("export") / "mesh.glb").write_bytes(b"mesh")
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    (run.stage("export") / "mesh.glb").unlink()
    (run.stage("export") / "point_cloud.spz").write_bytes(bytes(30_000))  # by `export --only`, later than the stage
    html = write_report(run).read_text()
    parsed = Balanced()
    parsed.feed(html)
    assert parsed.open == []
    assert parsed.images == 4 * 8 + 1
    headings = (
        "What the map shows", "What would improve it", "What was found", "Camera path", "Compared with ground truth",
        "Stages", "Settings",
    )  # fmt: skip
    places = [parsed.text.index(heading) for heading in headings]
    assert places == sorted(places)
    assert "depth, m: " in parsed.text
    assert "ATE Sim(3)" in parsed.text
    assert not re.search(r"\b(True|False|None)\b|[\[{]'", re.sub(r"<pre>.*?</pre>", "", html, flags=re.DOTALL))
    swatches = re.findall(r'<i style="background:rgb\((\d+),(\d+),(\d+)\)"></i>([^<]*) <span>([\d.]+)%', html)
    assert sum(float(share) for *_, share in swatches) == pytest.approx(100, abs=0.5)
    assert len(swatches) > 3
    assert "point_cloud.spz0.03 MB" in parsed.text
    assert re.search(r"world\.json\d+\.\d kB", parsed.text)
    assert f"mesh.glbmissing or damaged: msgs-slam resume {run.root}" in parsed.text
    lengths = found_lengths(load_outcome(run))
    assert len(lengths) == 5
    assert all(what in parsed.text and text in parsed.text for what, text in lengths)
    assert "<script" not in html
    assert "onload" not in html
    assert re.findall(r'(?:src|href)="(?!data:)', html) == []
    assert re.findall(r"https?://(?!www\.w3\.org/2000/svg)", html) == []
    assert len(html) < 3_000_000


def test_an_evaluation_of_an_earlier_map_is_not_shown_as_of_this_one(oracle_run: OracleRun, truth: Dataset) -> None:
    run = oracle_run()
    evaluation, outcome = write_evaluation(run, truth, max_views=1), load_outcome(run)
    assert "ATE Sim(3)" in truth_section(evaluation, outcome)
    for stage, what in (("tracking", "poses"), ("mapping", "map")):
        if stage in (outcome.pose_stage, outcome.map_stage):
            records = {**outcome.records, stage: replace(outcome.records[stage], content="of other settings")}
            text = truth_section(evaluation, replace(outcome, records=records))
            assert "ATE" not in text
            assert f"made for earlier {'poses and map' if outcome.pose_stage == stage == 'mapping' else what}" in text
    del evaluation[JUDGED]
    assert "ATE" not in truth_section(evaluation, outcome), "by an earlier version: of which map, nothing says"


def test_the_report_shows_the_mesh_and_links_the_page_beside_it(oracle_run: OracleRun, tmp_path: Path) -> None:
    """A wall of one colour, in front of the first camera, in the exported axes and turned as glTF wants it."""
    run = oracle_run()
    world = World("up", "floor", True, Similarity(2.0, np.eye(3), np.array([1.0, 0, 0])))
    export = run.stage("export")
    export.mkdir(exist_ok=True)
    WORLD.save(export, world)
    t = load_outcome(run).trajectory
    first = np.linalg.inv(t.cam_from_world[np.flatnonzero(t.is_keyframe)[0]])
    corners = np.array([[-9, -9, 3], [9, -9, 3], [9, 9, 3], [-9, 9, 3.0]]) @ first[:3, :3].T + first[:3, 3]
    corners = world.exported_from_run.apply(corners) @ world.gltf_from_exported.T
    texture = np.full((8, 8, 3), (200, 30, 120), np.uint8)
    wall = ClassMesh(
        corners.astype(np.float32), np.zeros((4, 3), np.uint8), np.zeros(2, np.uint8), np.arange(4),
        np.zeros((4, 2), np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32), texture,
    )  # fmt: skip
    write_mesh_glb(export / "mesh.glb", wall)
    (export / "map.html").write_text("<p>map</p>")
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    html = write_report(run).read_text()
    assert '<a href="export/map.html">' in html.partition("What the map shows")[0]
    shown = html.partition(">The mesh<")[2].partition("data:image/jpeg;base64,")[2].partition('"')[0]
    np.testing.assert_allclose(decode_rgb(base64.b64decode(shown), "").mean((0, 1)), (200, 30, 120), atol=4)
    assert "export/map.html" not in write_report(run, tmp_path / "other.html").read_text()
    (export / "mesh.glb").write_bytes(b"no mesh")
    assert ">The mesh<" not in write_report(run).read_text()


def test_the_report_shows_what_stands_still(oracle_run: OracleRun) -> None:
    run = oracle_run()
    frame = run.load(FRAMES)[16]
    left_out = np.zeros(run.image(frame).shape[:2], bool)
    left_out[-20:] = True
    LEFT_OUT.save(run.stage("frames"), left_out, frame.name)
    note_finished(run, ("frames", "proxy", "tracking"))
    assert "stands still, left out" not in write_report(run).read_text()
    manifest = read_manifest(run.manifest_file)
    frames = replace(manifest.records["frames"], figures={"still_left_out": 0.125})
    write_manifest(run.manifest_file, replace(manifest, records={**manifest.records, "frames": frames}))
    html = write_report(run).read_text()
    assert "<td>stands still, left out</td><td>12.5% of the image</td>" in html
    assert 'alt="left out, 1.60 s"' in html


def test_report_of_a_run_without_a_map_and_with_lost_frames(oracle_run: OracleRun) -> None:
    run = oracle_run()
    t = run.load(TRAJECTORY, "tracking")
    reasons = tuple("too few matches" if 5 <= i < 8 else ("blurred" if i == 8 else "") for i in range(32))
    lost = replace(t, is_keyframe=t.is_keyframe & ~np.array([bool(r) for r in reasons]), lost_reasons=reasons)
    TRAJECTORY.save(run.stage("tracking"), lost)
    note_finished(run, ("frames", "proxy", "tracking"))
    outcome = load_outcome(run)
    assert lost_stretches(outcome) == ["frames 5–7 (0.50–0.70 s): too few matches", "frames 8–8 (0.80–0.80 s): blurred"]
    html = write_report(run).read_text()
    assert "frames 5–7 (0.50–0.70 s): too few matches" in html
    assert "4 of 32 frames have no pose" in html
    note_finished(run, ())
    with pytest.raises(InputError, match="not done"):
        write_report(run)


def good_capture(count: int = 32) -> Capture:
    return Capture(np.ones(count), np.full(count, 120.0), np.full(count, 400))


def ring_model(radius: float, depth: float) -> SparseModel:
    """Cameras on a ring of `radius` that see points `depth` away."""
    angle = np.linspace(0, 2 * np.pi, 16)
    poses = np.tile(np.eye(4), (16, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = radius * np.cos(angle), radius * np.sin(angle)
    points = np.array([[0.0, 0.0, depth]])
    frames, zeros = np.arange(16), np.zeros(16, np.int64)
    return SparseModel(frames, poses, points, np.zeros((1, 3), np.uint8), frames, zeros, np.zeros((16, 2)))


def test_advice_says_what_is_wrong_and_nothing_else(oracle_run: OracleRun) -> None:
    outcome = load_outcome(oracle_run())
    model, loop = ring_model(1.0, 2.0), [LoopEdge(0, 30, np.eye(4), 1.0, 50)]
    fine = good_capture()
    assert advice(outcome, fine, model, loop, 30.0) == []
    blurred = replace(fine, sharpness=np.where(np.arange(32) % 4 == 0, 0.1, 1.0))
    swinging = replace(fine, brightness=np.linspace(60, 180, 32))
    dark = replace(fine, brightness=np.full(32, 20.0))
    bare = replace(fine, points=np.full(32, 20))
    found = {
        "8 of 32 frames are blurred": blurred, "lock the exposure": swinging, "very dark": dark, "bare walls": bare
    }  # fmt: skip
    for words, capture in found.items():
        (line,) = advice(outcome, capture, model, loop, 30.0)
        assert words in line
    assert "do not just turn" in advice(outcome, fine, ring_model(1.0, 500.0), loop, 30.0)[0]
    assert "16.0 dB" in advice(outcome, fine, model, loop, 16.0)[0]
    unsure_lens = replace(outcome, calibration=replace(outcome.calibration, origin="self-calibrated", focal_sd=20.0))
    assert "focal length is uncertain" in advice(unsure_lens, fine, model, loop, 30.0)[0]


def test_plots_keep_to_their_frame_and_leave_gaps() -> None:
    points = np.array([[0, 1.0], [1, 5.0], [2, np.nan], [3, 2.0]])
    svg = plot("a < b", "x", "y", [Line(points, "#000", "name")])
    assert "a &lt; b" in svg
    path = re.search(r'<path d="([^"]*)"', svg)
    assert path[1].count("M") == 2
    places = np.array(re.findall(r"[ML]([\d.]+) ([\d.]+)", path[1]), float)
    assert len(places) == 3
    assert (places > 0).all()
    assert (places < (560, 320)).all()
    assert ticks(0.0, 1.0) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(-3.1, 12.2) == [-2, 0, 2, 4, 6, 8, 10, 12] or ticks(-3.1, 12.2) == [0, 5, 10]
    assert "NaN" not in plot("nothing", "x", "y", [Line(np.full((3, 2), np.nan), "#000", "")])


@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed here to open the page with")
def test_on_a_phone_words_of_tables_stay_whole_and_nothing_scrolls_sideways(tmp_path: Path) -> None:
    long = "/home/somebody/" + "a_long_name_of_a_folder" * 4
    rows = [("global_ba", "30.7", "823", "keyframes 36, gaussians 100022, " + long), (long, "1", "2", "3")]
    body = section(
        "Stages", table(("stage", "seconds", "peak MB", "figures"), rows), f"<pre>{'many words ' * 30}</pre>"
    )
    (tmp_path / "page.html").write_text(page("A report", body))
    with browser(tmp_path / "profile", (390, 844)) as tab:
        tab.be_a_phone()
        tab.call("Page.navigate", url=(tmp_path / "page.html").as_uri())
        end = time.monotonic() + 60
        while tab.value("document.querySelectorAll('td').length") != 8:
            assert time.monotonic() < end
            time.sleep(0.2)
        assert tab.value("document.documentElement.scrollWidth") == 390
        head = "document.querySelector('th:nth-child(2)')"
        assert tab.value(f"{head}.clientHeight") < 40  # seconds in one line, not a letter in each
