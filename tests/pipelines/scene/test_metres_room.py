"""Metres of a room: from the camera's height and from things, whatever its unit; a guess changes no geometry."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished
from numpy.typing import NDArray

from msgs_slam.formats.textfile import read_json, write_json
from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.depth.fields import DepthFields
from msgs_slam.pipelines.export.stage import metres_figures
from msgs_slam.pipelines.export.stage import run as export
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.geometry.voxels import CEILING, FLOOR, OTHER, Gravity, Voxels
from msgs_slam.pipelines.networks.registry import _room_classes
from msgs_slam.pipelines.run.files import DEPTH_FIELDS, FIGURES, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.scene import metres as find
from msgs_slam.pipelines.scene.evidence import CEILING_HEIGHT, OUTDOORS, Evidence
from msgs_slam.pipelines.scene.metres import (
    Seen,
    contradiction,
    find_metres,
    is_room,
    known_evidence,
    load_seen,
    usual_evidence,
)
from msgs_slam.pipelines.scene.room import Scene, camera_height, ceiling_height, may_have_floor, sizes_of_things
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Metres

STAGES_DONE = ("frames", "proxy", "tracking", "mapping")
OracleRun = Callable[..., RunFolder]
ROTATION = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def moved(scale: float) -> Similarity:
    return Similarity(scale, ROTATION, np.array([3.0, -2, 1]))


@pytest.fixture(scope="module")
def run(oracle_run: OracleRun) -> RunFolder:
    """Its unit is 0.4 m; classes have their names, and come from files."""
    return oracle_run(moved(2.5), metric=False, pixel_stride=6)


def rescale_depth(run: RunFolder, factor: float) -> None:
    """What tracking says of proxy depth in a world of another unit."""
    t = run.load(TRAJECTORY, "tracking")
    ids = t.frame_ids[t.is_keyframe]
    DEPTH_FIELDS.save(run.stage("tracking"), DepthFields({int(i): np.full((9, 12), np.log(factor)) for i in ids}))
    note_finished(run, STAGES_DONE)


def found_in(run: RunFolder, guess: bool = True) -> tuple[Metres | None, str | None]:
    return find_metres(run, run.load(TRAJECTORY, "mapping"), guess, None)


def test_the_scale_is_found_within_its_sigmas_and_says_from_what(run: RunFolder) -> None:
    rescale_depth(run, 2.5)
    metres, _ = found_in(run)
    assert metres.is_guess
    assert abs(np.log(metres.per_unit / 0.4)) < 2 * metres.relative_sd
    assert 0.05 < metres.relative_sd <= 0.3
    assert metres.text.startswith("1 unit = about 0.")
    assert "(estimated from " in metres.text
    assert "floor height" in metres.sources


def test_it_follows_the_unit_of_the_world(run: RunFolder, oracle_run: OracleRun) -> None:
    rescale_depth(run, 2.5)
    other = oracle_run(moved(40.0), metric=False, pixel_stride=6)
    rescale_depth(other, 40.0)
    (first, _), (second, _) = found_in(run), found_in(other)
    assert first.per_unit / second.per_unit == pytest.approx(16.0, rel=0.03)


def test_free_units_stay_free_and_metric_ones_are_known(run: RunFolder, oracle_run: OracleRun) -> None:
    assert found_in(run, guess=False)[0] is None
    metric, _ = found_in(oracle_run(pixel_stride=6), guess=False)
    assert not metric.is_guess
    assert metric.per_unit == pytest.approx(1.0, abs=0.01)
    assert 0.01 < metric.relative_sd < 0.1


def test_depth_in_a_wrong_unit_is_doubted(oracle_run: OracleRun) -> None:
    run = oracle_run(moved(12.0), pixel_stride=6)
    rescale_depth(run, 12.0)
    _, warning = found_in(run)
    assert "Check its unit" in warning
    seen = load_seen(run, run.load(TRAJECTORY, "mapping"))
    assert contradiction(known_evidence(run), usual_evidence(seen, None)) == warning
    assert found_in(oracle_run(pixel_stride=6))[1] is None


def test_outdoors_no_size_is_guessed(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of each image is called sky; a tenth may be a window."""
    seen = load_seen(run, run.load(TRAJECTORY, "mapping"))
    classes = _room_classes(150)
    assert dict(zip(classes["classes"], classes["groups"], strict=True))["sky"] in OUTDOORS

    def showing(share: float) -> Seen:
        frames = []
        for frame in seen.frames:
            labels = frame.maps.labels.copy()
            labels[: round(share * len(labels))] = len(seen.names)
            frames.append(replace(frame, maps=replace(frame.maps, labels=labels)))
        return replace(seen, frames=frames, names=(*seen.names, "outdoors"), is_named=True)

    assert usual_evidence(showing(0.1), None)
    assert usual_evidence(showing(0.25), None) == []
    assert usual_evidence(replace(showing(0.25), is_named=False), None)
    monkeypatch.setattr(find, "load_seen", lambda *_: showing(0.25))
    metres, warning = found_in(run)
    assert metres is None
    assert "outdoors by its labels" in warning


def test_without_names_and_a_ceiling_the_size_holds_only_for_a_room(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = load_seen(run, run.load(TRAJECTORY, "mapping"))
    assert is_room(replace(seen, is_named=True), [])
    pieces = usual_evidence(replace(seen, is_named=False), None)
    ceiling = Evidence("ceiling height", CEILING_HEIGHT, pieces[0].modes)
    for named, evidence in ((True, pieces), (False, [*pieces, ceiling])):
        monkeypatch.setattr(find, "load_seen", lambda *_, named=named: replace(seen, is_named=named))
        monkeypatch.setattr(find, "usual_evidence", lambda *_, evidence=evidence: evidence)
        metres, warning = found_in(run)
        assert warning is None
        assert "if the scene" not in metres.text
    monkeypatch.setattr(find, "usual_evidence", lambda *_: [p for p in pieces if p.kind != CEILING_HEIGHT])
    metres, warning = found_in(run)
    assert "models pull" in warning
    assert metres.text.endswith(", if the scene is a room)")
    assert metres_figures(metres)["metres_from"].endswith("if the scene is a room")


def test_a_reference_wins_over_what_is_usual(run: RunFolder) -> None:
    report = run.load(FIGURES["proxy"])
    given = {"metric": True, "scale_from": "reference", "reference_relative_sd": 0.01}
    try:
        write_json(run.stage("proxy") / "proxy.json", report | given)
        rescale_depth(run, 2.5)
        metres, _ = found_in(run)
    finally:
        write_json(run.stage("proxy") / "proxy.json", report)
        note_finished(run, STAGES_DONE)
    assert metres.per_unit == pytest.approx(1.0, abs=0.03)
    assert metres.sources == ("the given reference",)


def test_an_export_with_a_guess_differs_in_words_only(run: RunFolder, tmp_path: Path) -> None:
    rescale_depth(run, 2.5)
    for scale in ("auto", "free"):
        (tmp_path / scale).mkdir()
        config = Config(export=ExportConfig(voxel=0.2, scale=scale))
        export(StageContext(run, run.root, config, tmp_path / scale, SilentProgress()))
    guessed, free = tmp_path / "auto", tmp_path / "free"
    names = {str(p.relative_to(free)) for p in free.rglob("*") if p.is_file()}
    differ = {n for n in names if (free / n).read_bytes() != (guessed / n).read_bytes()}
    assert differ == {"README.txt", "trajectory.txt", "scale.json", "map.html", "things.json"}
    metres = {name: None for name in ("metres", "metres_sd")}
    without = [[row | metres for row in read_json(f / "things.json")] for f in (guessed, free)]
    assert without[0] == without[1]
    rows = [[r for r in (f / "trajectory.txt").read_text().splitlines() if r[0] != "#"] for f in (guessed, free)]
    assert rows[0] == rows[1]
    for text in ((guessed / "trajectory.txt").read_text(), (guessed / "README.txt").read_text()):
        assert "about 0." in text
        assert "estimated from" in text
    assert "free" in (free / "trajectory.txt").read_text()
    assert read_json(free / "scale.json") is None
    told = read_json(guessed / "scale.json")
    assert told["is_guess"]
    assert "mean of its readings" in told["about_by_source"]


# scenes of voxels ------------------------------------------------------------------------------------------------


def plane(x: tuple[float, float], z: tuple[float, float], height: float, step: float = 0.05) -> NDArray[np.float64]:
    """(V, 3) level points; y is up."""
    grid = np.stack(np.meshgrid(np.arange(*x, step), [height], np.arange(*z, step)), -1)
    return grid.reshape(-1, 3)


def scene(parts: list[tuple[NDArray[np.float64], int, str]], centres: NDArray[np.float64]) -> Scene:
    """Level surfaces with a kind and a class each, seen by cameras."""
    points = np.concatenate([p for p, _, _ in parts])
    names = tuple(dict.fromkeys(name for _, _, name in parts))
    kind = np.concatenate([np.full(len(p), k) for p, k, _ in parts])
    label = np.concatenate([np.full(len(p), names.index(n), np.uint8) for p, _, n in parts])
    up = np.array([0.0, 1, 0])
    normals = np.tile(up, (len(points), 1))
    voxels = Voxels(
        0.05, np.arange(len(points)), np.full(len(points), 3.0), points, normals, np.zeros((len(points), 3))
    )
    return Scene(voxels, Gravity(up, True), kind, label, names, centres, 2.4)


CENTRES = np.stack([np.linspace(0, 4, 20), np.full(20, 1.5), np.full(20, 1.0)], 1)
FLOOR_PART = (plane((0, 5), (0, 4), 0.0), FLOOR, "floor")


def test_tables_and_seats_are_measured_each_by_itself() -> None:
    tables = [(plane((x, x + 1), (3, 3.6), 0.74), OTHER, "table") for x in (0.0, 3.0)]
    seat = (plane((1.8, 2.3), (3, 3.5), 0.45), OTHER, "chair")
    pieces = sizes_of_things(scene([FLOOR_PART, *tables, seat], CENTRES))
    assert sorted(p.source for p in pieces) == ["chair", "table", "table"]
    for piece in pieces:
        assert min(abs(m.log_scale) for m in piece.modes) < 0.08  # a voxel is 7 % of a table's height


def test_a_thing_of_two_names_tells_nothing() -> None:
    """Half of it is called a bed, the other half a chair."""
    bed, seat = (plane((x, x + 0.6), (3, 3.6), 0.5) for x in (0.0, 0.6))
    halves = [(bed, OTHER, "bed"), (seat, OTHER, "chair")]
    assert sizes_of_things(scene([FLOOR_PART, *halves], CENTRES)) == []
    agreed = sizes_of_things(scene([FLOOR_PART, (np.concatenate([bed, seat]), OTHER, "bed")], CENTRES))
    assert [p.source for p in agreed] == ["bed"]


def test_a_table_top_that_is_lowest_is_no_floor() -> None:
    only_table = scene([(FLOOR_PART[0], FLOOR, "table")], CENTRES)
    assert not may_have_floor(only_table)
    assert camera_height(only_table) == []
    assert sizes_of_things(only_table) == []
    assert may_have_floor(scene([(FLOOR_PART[0], FLOOR, "object 3")], CENTRES))
    assert may_have_floor(scene([FLOOR_PART], CENTRES))


@pytest.mark.parametrize(("low", "high"), [(-2.0, -0.2), (-0.5, 0.0), (-2.0, 2.0), (0.0, 2.0)])
def test_a_door_mirrored_below_the_floor_tells_nothing(low: float, high: float) -> None:
    heights = np.arange(low, high + 0.01, 0.05)
    x, y = np.meshgrid(np.arange(0, 0.9, 0.05), heights)
    door = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    room = scene([FLOOR_PART, (door, OTHER, "door")], CENTRES)
    room.voxels.normal[len(FLOOR_PART[0]) :] = [0.0, 0, 1]
    with np.errstate(all="raise"):
        pieces = sizes_of_things(room)
    assert [p.source for p in pieces] == (["door"] if high > 0 else [])
    assert all(np.isfinite(p.log_scale) and np.isfinite(p.sd) for p in pieces)


def test_a_ceiling_that_is_not_over_the_floor_tells_nothing() -> None:
    below = scene([FLOOR_PART, (plane((0, 5), (0, 4), -1.0), CEILING, "ceiling")], CENTRES)
    assert ceiling_height(below) == []
    above = scene([FLOOR_PART, (plane((0, 5), (0, 4), 2.4), CEILING, "ceiling")], CENTRES)
    assert len(ceiling_height(above)) == 1


def test_on_stairs_the_floor_tells_nothing() -> None:
    """Four metres up in twenty steps: over the lowest floor the camera hangs at 3.5 m on average."""
    steps = [(plane((0.25 * k, 0.25 * k + 0.25), (0, 1.2), 0.2 * k), OTHER, "stairs") for k in range(21)]
    along = np.linspace(-0.5, 5, 40)
    centres = np.stack([along, 1.5 + 0.8 * np.clip(along, 0, None), np.full(40, 0.6)], 1)
    climbed = scene([(plane((-2, 0), (0, 1.2), 0.0), FLOOR, "floor"), *steps], centres)
    assert camera_height(climbed) == sizes_of_things(climbed) == []
