"""The map as one HTML file: unpacked again here, and drawn by a browser beside our own renderer."""

import base64
import gzip
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.images import read_rgb
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.evaluation.metrics import psnr
from msgs_slam.pipelines.evaluation.views import view_map
from msgs_slam.pipelines.export import web_page
from msgs_slam.pipelines.export.inventory import FoundThings, Thing
from msgs_slam.pipelines.export.scene import ExportScene
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.export.things import STRUCTURE
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome, map_cloud
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.run.target import Target
from msgs_slam.pipelines.scene.world import FIRST, WORLD
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.browser import HANGS, browser, in_node

OracleRun = Callable[..., RunFolder]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SIZE = (640, 480)


@pytest.fixture(scope="module")
def page(oracle_run: OracleRun, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The page, and the outcome in its world."""
    run, folder = oracle_run(), tmp_path_factory.mktemp("web")
    assert [p.name for p in export_run(run, folder, "html")] == ["map.html", "world.json", "README.txt"]
    world = WORLD.read(folder / "world.json")
    return folder / "map.html", load_outcome(run).moved(world.exported_from_run)


def part(text: str, name: str) -> str:
    found = re.search(rf'<script [^>]*id="{name}">(.*?)</script>', text, re.DOTALL)
    return found[1]


def unpacked(text: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """What the page's script makes of it: about, (M, 4) places and radii, (M, 5) colours, opacities and classes."""
    about = json.loads(part(text, "about"))
    planes = np.frombuffer(gzip.decompress(base64.b64decode(part(text, "map"))), np.uint8).reshape(14, about["count"])
    steps = np.cumsum(planes[0:6:2].astype(np.int64) * 256 + planes[1:6:2], axis=1) % 65536
    low, high = np.array(about["low"])[:, None], np.array(about["high"])[:, None]
    logs = low + (high - low) * steps / 65535
    smallest, largest = about["log_radii"]
    radii = np.exp(smallest + (largest - smallest) * planes[6] / 255)
    return about, np.column_stack([*(np.sign(logs) * np.expm1(np.abs(logs))), radii]), planes[7:].T


def test_nothing_is_fetched_and_the_map_is_whole(page: tuple[Path, Outcome]) -> None:
    path, outcome = page
    text = path.read_text(encoding="utf-8")
    assert not re.findall(r"https?://", text)
    assert "default-src 'none'" in text
    about, places, rest = unpacked(text)
    m = outcome.require_map()
    assert about["count"] == about["total"] == len(m)
    size = np.ptp(m.means.numpy(), axis=0).max()
    near = np.sort(m.means.numpy(), axis=0), np.sort(places[:, :3], axis=0)
    assert 0 < np.abs(near[0] - near[1]).max() < 1e-4 * size
    np.testing.assert_allclose(np.sort(places[:, 3]), np.sort(m.radii.numpy()), rtol=0.02)
    classes = np.bincount(rest[:, 4], minlength=len(outcome.classes))[: len(outcome.classes)] / len(m)
    np.testing.assert_allclose([c["share"] for c in about["classes"]], classes, atol=1e-5)
    assert len(text) < 20 * len(m) + 60_000
    assert [camera["n"] for camera in about["cameras"]] == outcome.trajectory.frame_ids.tolist()


def test_names_cannot_become_a_part_of_the_page(oracle_run: OracleRun, tmp_path: Path) -> None:
    outcome = load_outcome(oracle_run())
    bad = "</script><script>alert(1)</script>{{script}}"
    classes = replace(outcome.classes, names=(bad, *outcome.classes.names[1:]))
    folder = tmp_path / "run"
    outcome = replace(outcome, classes=classes, run=RunFolder(folder / "<b>{{map}}.msgs"))
    web_page.write_web_page(
        ExportScene(outcome, FIRST, StageContext(outcome.run, tmp_path, Config(), tmp_path, SilentProgress())),
        Target(tmp_path),
    )
    text = (tmp_path / "map.html").read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert json.loads(part(text, "about"))["classes"][0]["name"] == bad
    assert "<title>&lt;b&gt;{{map}}</title>" in text


def test_a_large_map_keeps_what_is_seen_most(page: tuple[Path, Outcome], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_page, "MAX_GAUSSIANS", 500)
    cloud = map_cloud(page[1])
    about, packed = web_page.pack_cloud(cloud, np.eye(3))
    assert (about["count"], about["total"]) == (500, len(cloud))
    assert len(gzip.decompress(packed)) == 14 * 500
    assert about["log_radii"][0] > np.median(cloud.log_scales)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed here to open the page with")
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_browser_draws_what_we_draw(page: tuple[Path, Outcome], tmp_path: Path, share: float) -> None:
    path, outcome = page
    cameras = json.loads(part(path.read_text(encoding="utf-8"), "about"))["cameras"]
    number = round(share * (len(cameras) - 1))
    shot = read_rgb(screenshot(f"{path.as_uri()}#camera={cameras[number]['n']}&bare", tmp_path))
    t, k = outcome.trajectory, outcome.calibration.intrinsics
    row = int(np.argmin(np.linalg.norm(t.centers - cameras[number]["p"], axis=1)))
    (width, height), focal = SIZE, min(SIZE[0] * k.fx / k.width, SIZE[1] * k.fy / k.height)
    cx, cy = width / 2 + focal * (k.cx - k.width / 2) / k.fx, height / 2 + focal * (k.cy - k.height / 2) / k.fy
    intrinsics = replace(k, width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy)
    drawn = view_map(outcome.require_map(), outcome.label_of_channel, intrinsics, t.cam_from_world[row])
    assert 30 < psnr(shot, drawn.exposed(None, 0.0)) < 80


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed here to open the page with")
def test_fingers_on_a_phone_measure_turn_and_zoom(page: tuple[Path, Outcome], tmp_path: Path) -> None:
    text = "document.getElementById('note').textContent"
    with browser(tmp_path / "profile", (390, 844)) as tab:
        tab.be_a_phone()
        tab.call("Page.navigate", url=page[0].as_uri())
        tab.until(lambda: tab.value("document.documentElement.dataset.ready") == "1")
        assert tab.value("document.documentElement.scrollWidth") == 390
        below = "document.getElementById('stage').getBoundingClientRect().bottom"
        assert tab.value(below) > 0.9 * 844  # a row of icons has the rest
        heights = "[...document.querySelectorAll('#bar button')].map((b) => b.getBoundingClientRect().top)"
        assert tab.value(f"new Set({heights}).size") == 1
        assert tab.tap("document.getElementById('measure')")
        tab.until(lambda: "tap two places" in tab.value(text))
        tab.fingers([(150, 300)])
        tab.until(lambda: "second place" in tab.value(text))
        tab.fingers([(280, 340)])
        tab.until(lambda: "±" in tab.value(text))
        before = tab.scene()
        tab.fingers([(150 + 10 * n, 300) for n in range(8)])
        turned = tab.wait_for_change(before)
        tab.fingers([(170 - 10 * n, 300) for n in range(8)], [(230 + 10 * n, 300) for n in range(8)])
        tab.wait_for_change(turned)
        assert "±" in tab.value(text)  # neither is a tap
        tab.until(lambda: tab.tap("document.getElementById('fold')"))
        tab.until(lambda: 0.5 * 844 < tab.value(below) < 0.8 * 844)


def script(*names: str) -> str:
    return "\n".join((web_page.PARTS / name).read_text(encoding="utf-8") for name in names)


def test_a_place_is_sure_around_where_cameras_saw_it_from_the_more_of_them_the_farther() -> None:
    ahead = [1, 0, 0, 0, 0, -1, 0, 1, 0]  # along y
    cameras = [{"r": ahead, "p": [x, 0, 0]} for x in (-2, 2)]
    places = [0, 2, 0, 1, 2, 2, 0, 1, 9, 2, 0, 1, 0, -2, 0, 1]  # seen by both, by one, by none
    cloud, about = {"places": places, "count": 4}, {"cameras": cameras, "slope": [2.1, 2.1]}
    found = in_node(script("cloud.js"), "[...seenFrom(cloud, about)]", cloud=cloud, about=about)
    cones = np.array(found).reshape(4, 4) / 127
    np.testing.assert_allclose(cones[:2, :3], [[0, -1, 0], [0, -1, 0]], atol=0.01)
    np.testing.assert_allclose(np.degrees(np.arccos(cones[:2, 3])), [45 + 40, 35], atol=1)
    assert not cones[2:].any()


def test_the_first_look_is_level_and_leaves_nothing_empty() -> None:
    """A wall of 8 by 4 at y = 2, and cameras rolled by 20 degrees: before its middle, before its end, looking away."""
    x, z = np.meshgrid(np.arange(-4, 4, 0.05), np.arange(-2, 2, 0.05))
    places = np.stack([x, np.full_like(x, 2.0), z, np.full_like(x, 0.05)], axis=-1).ravel()
    colors = np.full(x.size * 4, 250)
    turns = Rotation.from_euler("z", 20, degrees=True).as_matrix() @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    away = turns * [[1], [1], [-1]]
    cameras = [
        {"p": p, "r": r.ravel().tolist()} for p, r in (([3, 0, 0], turns), ([0, 0, 0], turns), ([0, 0, 0], away))
    ]
    about = {"cameras": cameras, "slope": [1.6, 1.2], "shift": [0, 0]}
    cloud = {"places": places.tolist(), "colors": colors.tolist(), "count": x.size}
    work = "(cloud.cones = seenFrom(cloud, about), areas.map((area) => firstLook(cloud, about, area)))"
    areas = [{"width": 800, "height": 600}, {"width": 1600, "height": 600}, {"width": 400, "height": 800}]
    scripts = script("cloud.js", "moves.js", "look.js")
    whole, wide, high = in_node(scripts, work, cloud=cloud, about=about, areas=areas)
    for look in (whole, wide, high):
        right, down, forward = np.reshape(look["camera"]["r"], (3, 3))
        np.testing.assert_allclose((right[2], forward @ [0, 1, 0]), (0, 1), atol=1e-9)
        assert down[2] < -0.99
    assert whole["camera"]["p"] == wide["camera"]["p"] == [0, 0, 0]
    assert whole["zoom"] == 1
    assert 1 < wide["zoom"] <= 1.1 * 2  # what only the camera at the end has seen is faded from here
    assert 1.1 < high["zoom"] <= 1.1 * 2.7  # and not above it


def test_a_recorded_path_is_in_the_world_of_the_files() -> None:
    turns = Rotation.random(50, np.random.default_rng(0))
    turn, shift = Rotation.from_euler("xyz", (20, 30, 40), degrees=True), np.array([1.0, 2, 3])
    keyframes = [{"p": [k, 2.0, -1], "r": m.T.ravel().tolist()} for k, m in enumerate(turns.as_matrix())]
    recorded = {"world": "run", "turn": turn.as_matrix().ravel().tolist(), "shift": shift.tolist()}
    about = {"slope": [1.5, 2 * np.tan(np.radians(25))], "recorded": recorded}
    expression = "JSON.parse(recordedPath(keyframes, about))"
    path = in_node(script("cloud.js", "moves.js", "record.js"), expression, keyframes=keyframes, about=about)
    wxyz = np.array([key["rotation_wxyz"] for key in path["keyframes"]])
    assert (Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).inv() * turn * turns).magnitude().max() < 1e-6
    places = np.array([key["position"] for key in path["keyframes"]])
    np.testing.assert_allclose(places, turn.apply([key["p"] for key in keyframes]) + shift, atol=1e-9)
    assert path["keyframes"][0]["fov_degrees"] == pytest.approx(50)


def test_the_tape_is_true_within_what_it_states(page: tuple[Path, Outcome], truth: Dataset) -> None:
    text, outcome = page[0].read_text(encoding="utf-8"), page[1]
    c, rng, rows, rays, places = truth.camera, np.random.default_rng(1), [], [], []
    for _ in range(120):
        row = 4 * int(rng.integers(0, 8))
        u, v = int(rng.integers(5, c.width - 5)), int(rng.integers(5, c.height - 5))
        depth, pose = truth.depth(row), outcome.trajectory.world_from_cam[row]
        ray = np.array([(u + 0.5 - c.cx) / c.fx, (v + 0.5 - c.cy) / c.fy, 1])
        rays.append([pose[:3, 3].tolist(), (pose[:3, :3] @ ray / np.linalg.norm(ray)).tolist()])
        places.append(pose[:3, :3] @ (depth[v, u] * ray) + pose[:3, 3])
    measure = """unpackCloud(about, map).then((cloud) => {
      const met = rays.map(([from, ray]) => touchCloud(cloud, from, ray));
      met.forEach((end) => { if (end) end.across = end.depth / focal; });
      const pairs = [...Array(met.length / 2).keys()].map((k) => [met[2 * k], met[2 * k + 1]]);
      return pairs.map(([a, b]) => (a && b ? tapeBetween(a, b, about) : null));
    })"""
    about = json.loads(part(text, "about"))
    found = in_node(
        script("cloud.js", "moves.js", "tape.js"), measure, about=about, map=part(text, "map"), rays=rays, focal=c.fx
    )
    for k, said in enumerate(found):
        if said:
            length, sd = map(float, re.fullmatch(r"([\d.]+) ± ([\d.]+) m", said).groups())
            rows.append((abs(length - np.linalg.norm(places[2 * k] - places[2 * k + 1])), sd))
    assert len(rows) > 50
    error, sd = np.array(rows).T
    assert 0 < np.median(error) < 0.03
    assert 0.4 < np.mean(error < sd) < 0.99
    assert np.mean(error < 3 * sd) > 0.85


def screenshot(address: str, folder: Path) -> Path:
    target = folder / "shot.png"
    words = ["--headless", "--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-sync"]
    words += ["--disable-component-update", "--disable-quic", "--hide-scrollbars", f"--user-data-dir={folder / 'user'}"]
    words += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--virtual-time-budget=20000"]
    words += ["--window-size={},{}".format(*SIZE), f"--screenshot={target}", address]
    done = subprocess.run([str(CHROMIUM), *words], capture_output=True, text=True, timeout=HANGS)
    assert target.exists(), done.stderr[-1000:]
    return target


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed here to open the page with")
def test_a_thing_is_clicked_hidden_shown_alone_and_its_command_copied(
    page: tuple[Path, Outcome], tmp_path: Path
) -> None:
    outcome, world = page[1], WORLD.read(page[0].with_name("world.json"))
    means, (things, name) = outcome.require_map().means.numpy(), one_thing(outcome)
    path = tmp_path / "map.html"
    path.write_text(web_page.page_of(outcome, world, things=things), encoding="utf-8")
    t, k = outcome.trajectory, outcome.calibration.intrinsics
    row, (u, v) = seen_from(outcome, means[things.numbers == 1])
    note, by_id = "document.getElementById('note').textContent", "document.getElementById({!r})"
    with browser(tmp_path / "profile", SIZE) as tab:
        tab.call("Page.navigate", url=f"{path.as_uri()}#camera={t.frame_ids[row]}&bare")
        tab.until(lambda: tab.value("document.documentElement.dataset.ready") == "1")
        assert tab.value(f"{by_id.format('thing')}.hidden")
        whole, (width, height) = tab.scene(), tab.canvas()
        scale = min(width / k.width, height / k.height)
        tab.click(width / 2 + scale * (u - k.width / 2), height / 2 + scale * (v - k.height / 2))
        tab.until(lambda: tab.value(note).startswith(f"{name}: 1.00 x 0.50 x 0.80 m"))
        assert "seen in 7 views, 65% sure" in tab.value(note)
        assert tab.value(f"{by_id.format('things')}.value") == "1"
        tab.value(f"{by_id.format('hide')}.click()")
        tab.wait_for_change(whole)
        tab.value(f"{by_id.format('copy')}.click()")
        tab.until(lambda: tab.value(note) == f'msgs-slam export RUN --without "{name}"')
        tab.value(f"{by_id.format('hide')}.click()")
        tab.until(lambda: np.abs(tab.scene().astype(int) - whole).mean() < 1)
        tab.value(f"{by_id.format('alone')}.click()")
        alone = tab.wait_for_change(whole)
        assert (alone.max(axis=2) < 8).mean() > (whole.max(axis=2) < 8).mean() + 0.2, "the rest is black"
        tab.value(f"{by_id.format('copy')}.click()")
        tab.until(lambda: tab.value(note) == f'msgs-slam export RUN --only-things "{name}"')
        tab.value(f"{by_id.format('all')}.click()")
        tab.until(lambda: np.abs(tab.scene().astype(int) - whole).mean() < 1)
        assert tab.value(f"{by_id.format('thing')}.hidden")


def one_thing(outcome: Outcome) -> tuple[FoundThings, str]:
    """The Gaussians of the map's largest class but walls, floor and ceiling, as a thing; and its name."""
    cloud = map_cloud(outcome)
    names = outcome.classes.names
    counts = np.bincount(cloud.class_ids, minlength=len(names)) * [n not in STRUCTURE for n in names]
    label, name = int(counts.argmax()), f"{names[int(counts.argmax())]} 1"
    axes, size = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)), (1.0, 0.5, 0.8)
    center = tuple(cloud.means[cloud.class_ids == label].mean(axis=0).tolist())
    thing = Thing(1, name, label, 1.0, center, axes, size, (0.01,) * 3, 500, 0, 7, 0.65, size, (0.1, 0.05, 0.08))
    return FoundThings((thing,), cloud.means, (cloud.class_ids == label).astype(np.uint16), 0.01), name


def seen_from(outcome: Outcome, points: np.ndarray) -> tuple[int, tuple[float, float]]:
    """The keyframe that sees most of the points, and the pixel of the one in their middle."""
    k = outcome.calibration.intrinsics
    best: tuple[int, int, tuple[float, float]] = (0, 0, (0.0, 0.0))
    for row in np.flatnonzero(outcome.trajectory.is_keyframe).tolist():
        pose = outcome.trajectory.cam_from_world[row]
        shown = view_map(outcome.require_map(), outcome.label_of_channel, k, pose)
        cam = points @ pose[:3, :3].T + pose[:3, 3]
        u, v = (k.fx * cam[:, 0] / cam[:, 2] + k.cx, k.fy * cam[:, 1] / cam[:, 2] + k.cy)
        inside = (cam[:, 2] > 0.1) & (u > 0) & (v > 0) & (u < k.width) & (v < k.height)
        rows = np.flatnonzero(inside)
        rows = rows[np.abs(shown.depth[v[rows].astype(int), u[rows].astype(int)] - cam[rows, 2]) < 0.05]
        if len(rows) > best[1]:
            middle = rows[np.hypot(u[rows] - np.median(u[rows]), v[rows] - np.median(v[rows])).argmin()]
            best = row, len(rows), (float(u[middle]), float(v[middle]))
    return best[0], best[2]
