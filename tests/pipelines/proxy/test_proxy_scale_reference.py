"""Metres from a known distance or the camera's height; malformed references are refused before anything slow."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from proxy_room import UNIT, Room

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png
from msgs_slam.pipelines.geometry.camera import unproject, unproject_depth
from msgs_slam.pipelines.proxy.reference import Reference, parse_reference
from msgs_slam.pipelines.proxy.selection import check_proxy
from msgs_slam.pipelines.proxy.stage import run
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import FRAMES, PROXY_MAPS, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.tracking.stage import run as track

Make = Callable[..., StageContext]
EMBEDDED = ("proxy.stereo_side=128",)


def known_length(room: Room, frame: int, points: tuple[tuple[float, float], tuple[float, float]]) -> float:
    view, xy = room.views[frame], np.array(points)
    column, row = np.floor(xy).astype(int).T
    first, second = unproject(xy, view.depth[row, column].astype(np.float64), room.calibration.intrinsics)
    return float(np.linalg.norm(second - first))


def setting(text: str) -> str:
    return f'proxy.scale_ref="{text}"'


def test_references_are_read() -> None:
    assert parse_reference("  ") is None
    assert parse_reference("height=1.55") == Reference(1.55)
    assert parse_reference("height = 1.6 m") == Reference(1.6)
    both = Reference(0.6, "IMG_12.png", (310.0, 240.0, 402.0, 238.5))
    assert parse_reference("IMG_12.png:310,240,402,238.5=0.60") == both
    assert parse_reference("IMG_12.png: 310, 240, 402, 238.5 = 0.60 m") == both


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0.6", "expected IMAGE:X1"),
        ("100,20,300,20=1", "expected IMAGE:X1"),
        ("height=-1", "make no sense"),
        ("height=0", "make no sense"),
        ("height=1.2.3", "expected IMAGE:X1"),
        ("000003.png:1,2,3=1", "expected IMAGE:X1"),
        ("000003.png:100,20,100.5,20=1", "nearly the same"),
        ("000003.png:10,20,100,20=99999", "make no sense"),
        ("nowhere.png:10,20,100,20=1", "has no image nowhere.png"),
        ("000003.png:10,20,300,20=1", r"outside the image \(256x192\)"),
    ],
)
def test_bad_references_are_refused_before_anything_slow(
    make_context: Make, tmp_path: Path, text: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = make_context().source
    monkeypatch.setattr("msgs_slam.pipelines.run.runner._run_one", lambda *_: pytest.fail("a stage was run"))
    config = load_config(overrides=[setting(text), "run.device=cpu"])
    with pytest.raises(InputError, match=said):
        reconstruct(source, RunFolder(tmp_path / "new"), config, SilentProgress())
    assert not (tmp_path / "new").exists()
    check_proxy(source, load_config(overrides=[setting("000003.png:10,20,100,20=1"), "proxy.depth=multiview"]))


def test_a_known_distance_gives_metres(room: Room, make_context: Make) -> None:
    points = ((60.5, 80.5), (190.5, 100.5))
    length = known_length(room, 5, points)
    text = f"000005:{points[0][0]},{points[0][1]},{points[1][0]},{points[1][1]}={length:.4f}"
    context = make_context(*EMBEDDED, setting(text))
    report = run(context)
    assert (report["metric"], report["scale_from"], report["independent_depth"]) == (True, "reference", False)
    assert report["metres_per_unit"] == pytest.approx(1 / UNIT, rel=0.02)
    assert report["metres_per_unit"] != pytest.approx(1 / UNIT, rel=1e-7)
    assert report["reference_keyframes"] > 1  # not the named picture alone
    assert 0 < report["reference_relative_sd"] < 0.05
    maps, view = context.run.load(PROXY_MAPS, of=5), room.views[5]
    ratio = maps.depth / view.depth
    assert np.median(ratio[maps.confidence > 0.35]) == pytest.approx(1, rel=0.02)


def test_tracking_makes_the_world_metric_by_it_without_taking_the_depth_for_news(
    room: Room, make_context: Make
) -> None:
    points = ((60.5, 80.5), (190.5, 100.5))
    text = f"000005:60.5,80.5,190.5,100.5={known_length(room, 5, points):.4f}"
    context = make_context(*EMBEDDED, setting(text))
    reference = run(context)
    context.run.stage("tracking").mkdir()
    tracking = StageContext(
        context.run, context.source, context.config, context.run.stage("tracking"), SilentProgress()
    )
    figures = track(tracking)
    assert figures["scale"] == "metric"
    assert figures["scale_relative_sd"] == reference["reference_relative_sd"]
    centres = np.linalg.inv(context.run.load(TRAJECTORY, "tracking").cam_from_world)[:, :3, 3]
    truth = np.array([v.world_from_cam[:3, 3] for v in room.views])
    walked = np.linalg.norm(centres[-1] - centres[0]) / np.linalg.norm(truth[-1] - truth[0])
    assert walked == pytest.approx(1, rel=0.02)


def test_the_height_of_the_camera_gives_metres(room: Room, make_context: Make) -> None:
    camera = room.calibration.intrinsics
    clouds = [
        unproject_depth(v.depth, camera) @ v.world_from_cam[:3, :3].T + v.world_from_cam[:3, 3] for v in room.views
    ]
    floor = min(float(np.percentile(c[v.depth > 0][:, 2], 0.5)) for c, v in zip(clouds, room.views, strict=True))
    height = float(np.median([v.world_from_cam[2, 3] for v in room.views])) - floor
    report = run(make_context(*EMBEDDED))
    assert (report["metric"], report["scale_from"]) == (False, "nothing: lengths have no unit")
    report = run(make_context(setting(f"height={height:.3f}"), name="again"))
    assert report["scale_from"] == "reference"
    assert report["metres_per_unit"] == pytest.approx(1 / UNIT, rel=0.015)


def test_metric_depth_wins_and_the_difference_is_told(room: Room, make_context: Make) -> None:
    points = ((60.5, 80.5), (190.5, 100.5))
    text = f"000005:60.5,80.5,190.5,100.5={1.1 * known_length(room, 5, points):.4f}"
    context = make_context("proxy.depth=files", "proxy.semantics=files", setting(text))
    report = run(context)
    assert (report["scale_from"], report["independent_depth"]) == ("depth", True)
    assert report["metres_per_unit"] == pytest.approx(1 / UNIT, rel=2e-3)
    said = next(w for w in context.warnings if "is not used" in w)
    assert re.search(r"\+(9|10)\.\d% longer", said), said


def test_a_picture_whose_points_are_lost_says_what_to_choose(make_context: Make) -> None:
    unfused = ("proxy.depth=files", "proxy.semantics=files", "run.method=paper")
    context = make_context(*unfused, setting("000005:2.5,3.5,60.5,3.5=1"))
    for path in (context.source.parent / "depth").iterdir():
        path.unlink()
    for frame in context.run.load(FRAMES):
        write_grey_png(context.source.parent / "depth" / frame.name, np.eye(192, 256, dtype=np.uint16) * 1000)
    with pytest.raises(InputError, match="reliable depth at both points"):
        run(context)
