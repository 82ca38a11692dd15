"""Walls of rooms whose lengths are known, and the plan that shows them."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from finished import note_finished
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.export.floor_plan import floor_plan, levelled
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.export.walls import Wall, find_walls
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.world import SAME, WORLD, World

OracleRun = Callable[..., RunFolder]
ROOM = np.array([[0.0, 0], [6.4, 0], [6.4, 3.1], [4.2, 3.1], [4.2, 5.2], [0, 5.2]])
"""An L, counterclockwise."""
_HALF = np.array([[0.0, 5], [1.3, 5], [1.3, 5.25], [2.4, 5.95]])
BAY = np.concatenate([[[0, 0], [6, 0]], (6, 0) + _HALF * (-1, 1), _HALF[::-1]])
"""A room with a bay window between two short walls, its sides behind the corners."""


def room(noise: float, degrees: float = 0.0) -> trimesh.Trimesh:
    """The walls of `ROOM`, a floor, a cupboard before the longest wall and a table; faces look into the room."""
    rng, parts = np.random.default_rng(0), []
    for first, second in zip(ROOM, np.roll(ROOM, -1, axis=0), strict=True):
        parts.append(sheet(first, second, 0, 2.6))
    parts += [sheet(np.array(a), np.array(b), 0, 2.0) for a, b in (((2.0, 0.5), (3.4, 0.5)), ((3.4, 0.0), (3.4, 0.5)))]
    table = trimesh.creation.box((1.4, 0.8, 0.75)).subdivide_to_size(0.1)
    parts.append(table.apply_translation((2, 3, 0.375)))
    mesh = trimesh.util.concatenate(parts)
    mesh.vertices += rng.normal(size=mesh.vertices.shape) * noise
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 0, 1)))


def sheet(first: NDArray, second: NDArray, low: float, high: float) -> trimesh.Trimesh:
    """An upright rectangle whose faces look to the left of the way from the first place to the second."""
    corners = [(*first, low), (*second, low), (*second, high), (*first, high)]
    plain = trimesh.Trimesh(corners, [(0, 2, 1), (0, 3, 2)], process=False)
    return plain.subdivide_to_size(0.1)


@pytest.mark.parametrize(("noise", "degrees"), [(0.0, 0.0), (0.008, 33.0)])
def test_walls_are_as_long_as_they_are(noise: float, degrees: float) -> None:
    mesh = room(noise, degrees)
    walls = find_walls(mesh.vertices, mesh.faces)
    true = np.linalg.norm(np.roll(ROOM, -1, axis=0) - ROOM, axis=1)
    assert all(wall.is_whole for wall in walls)  # and so the cupboard and the table are none
    np.testing.assert_allclose([wall.length for wall in walls], sorted(true, reverse=True), rtol=0.01)
    middle = Rotation.from_euler("z", degrees, degrees=True).apply([1.5, 2.5, 0])[:2]
    for wall in walls[:2]:
        assert (middle - wall.ends[0]) @ wall.normal > 0


def test_a_bay_window_does_not_take_the_walls_beside_it() -> None:
    sheets = [sheet(a, b, 0, 2.6) for a, b in zip(BAY, np.roll(BAY, -1, axis=0), strict=True)]
    mesh = trimesh.util.concatenate(sheets)
    mesh.vertices += np.random.default_rng(0).normal(size=mesh.vertices.shape) * 0.008
    walls = find_walls(mesh.vertices, mesh.faces)
    np.testing.assert_allclose([wall.length for wall in walls[:3]], [6, 5, 5], rtol=0.01)
    assert [wall.sign for wall in walls[:3]] == ["", "", ""]
    assert {wall.sign for wall in walls[3:]} == {"≈ ", "≥ "}
    seen = 0
    for a, b in zip(BAY, np.roll(BAY, -1, axis=0), strict=True):
        true = np.linalg.norm(b - a)
        seen += any(np.abs(w.ends - (a, b)).max() < 0.15 and abs(w.length - true) < 0.15 for w in walls)
    assert seen == len(walls) == len(BAY) - 1  # one of the two pieces of 25 cm is missed


@pytest.mark.parametrize("deep", [0.18, 0.19, 0.195, 0.2])
@pytest.mark.parametrize("top", [1.2, 1.3, 1.4])
def test_a_long_shelf_before_a_wall_is_no_riddle(deep: float, top: float) -> None:
    """Two surfaces of about one size, some four steps apart: the line between them lies on neither."""
    front = [sheet(np.array([0.0, deep]), np.array([6.4, deep]), 0, top)]
    walls = [sheet(ROOM[k], ROOM[(k + 1) % 6], top if k == 0 else 0, 2.6) for k in range(6)]
    mesh = trimesh.util.concatenate(front + walls)
    mesh.vertices += np.random.default_rng(0).normal(size=mesh.vertices.shape) * 0.001
    found = find_walls(mesh.vertices, mesh.faces)
    assert len(found) == 6
    assert found[0].length == pytest.approx(6.4, rel=0.02)


def test_a_wall_that_ends_unseen_says_so_and_nothing_upright_is_none() -> None:
    mesh = sheet(np.array([0.0, 0]), np.array([4.0, 0]), 0, 2.5) + sheet(np.array([4.0, 0]), np.array([4.0, 3]), 0, 2.5)
    walls = find_walls(mesh.vertices, mesh.faces)
    assert [(round(w.length, 1), w.is_whole, sum(w.corners)) for w in walls] == [(4.0, False, 1), (3.0, False, 1)]
    flat = trimesh.creation.box((4, 4, 0.01))
    assert find_walls(flat.vertices, flat.faces[:0]) == []
    assert Wall(np.array([[0.0, 0], [0, 2]])).normal.tolist() == [-1, 0]


def test_a_plan_says_what_is_open_and_no_digits_that_nobody_knows() -> None:
    open_walls = [
        Wall(np.array([[0.0, 0], [6.34, 0]]), (False, True)),
        Wall(np.array([[6.34, 0], [6.34, 3]]), (True, False)),
    ]
    closed = [Wall(np.array([a, b]), (True, True)) for a, b in zip(ROOM, np.roll(ROOM, -1, axis=0), strict=True)]
    path = np.zeros((2, 3))
    exact = floor_plan(open_walls, path, "room", 1.0, "m", "")
    assert "2 walls were found; 2 of their ends meet no other wall. Film the corners" in exact
    assert "6.34 m" in exact
    for spread, told in ((0.25, "6 m"), (0.1, "6.3 m"), (0.002, "6.34 m")):
        assert f"≥ {told}<" in floor_plan(open_walls, path, "room", 1.0, "m", "", spread)
    assert "Film" not in floor_plan(closed, path, "room", 1.0, "m", "")


@pytest.mark.parametrize("degrees", [4.0, 41.0, 139.0, -92.0])
def test_the_longest_wall_lies_along_an_edge_of_the_paper(degrees: float) -> None:
    turn = np.array([[np.cos(a := np.radians(degrees)), np.sin(a)], [-np.sin(a), np.cos(a)]])
    square = [Wall(np.array([[0.0, 0], [5, 0]]) @ turn), Wall(np.array([[5.0, 0], [5, 3]]) @ turn)]
    path = np.array([[1.0, 1, 1.5], [2, 2, 1.5]])
    path[:, :2] = path[:, :2] @ turn
    walls, way = levelled(square, path)
    assert [min(np.abs(wall.along)) for wall in walls] == pytest.approx([0, 0], abs=1e-9)
    for before, after in zip(square, walls, strict=True):
        assert before.along @ after.along >= np.cos(np.radians(45)) - 1e-9, "by the smaller turn"
        assert (way[0] - after.ends[0]) @ after.normal == pytest.approx(1 if after is walls[0] else 4)


def test_the_plan_of_a_run(oracle_run: OracleRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no mesh yet"):
        export_run(oracle_run(), tmp_path / "none", "floorplan")
    assert not (tmp_path / "none").exists()
    run = oracle_run(mesh=True)
    mesh = room(0.005)
    mesh.visual.vertex_colors = np.full((len(mesh.vertices), 4), 200, np.uint8)
    mesh.export(run.stage("export") / "mesh.ply")
    WORLD.save(run.stage("export"), World("first", "", False, SAME))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    with pytest.raises(InputError, match="which way is up"):
        export_run(run, tmp_path, "floorplan")
    WORLD.save(run.stage("export"), World("up", "floor", True, SAME))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    path = export_run(run, tmp_path, "floorplan")[0]
    svg = ET.parse(path).getroot()
    told = [t.text or "" for t in svg.iter("{http://www.w3.org/2000/svg}text")]
    lengths = sorted(float(m[1]) for t in told if (m := re.fullmatch(r"(\d+\.\d+) m", t)))
    np.testing.assert_allclose(lengths, [2.1, 2.2, 3.1, 4.2, 5.2, 6.4], rtol=0.02)
    assert len(list(svg.iter("{http://www.w3.org/2000/svg}polyline"))) == 1
