"""Things of rooms whose things are known: found whatever they are called, kept by number, left out without a hole."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import trimesh
from click.testing import CliRunner
from finished import note_finished
from numpy.typing import NDArray

import msgs_slam
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.glb import read_mesh_glb
from msgs_slam.formats.ply import MeshArrays, MeshBlocks, read_mesh_ply, read_mesh_things, write_mesh_ply
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.export.holes import cut_mesh
from msgs_slam.pipelines.export.inventory import THINGS, Selection, in_metres, inventory_csv, things_in
from msgs_slam.pipelines.export.kinds import EXPORTS
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.export.things import find_things
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.world import SAME, WORLD, World

OracleRun = Callable[..., RunFolder]
NAMES = ("wall", "floor", "chair", "object 1")
UPRIGHT = World("up", "floor", True, SAME)
STEP = 0.05


def sheet(corner: tuple, first: tuple, second: tuple, color: tuple = (200, 200, 200)) -> trimesh.Trimesh:
    """A rectangle of squares, seen from where first x second points to."""
    corner, first, second = (np.array(v, float) for v in (corner, first, second))
    wide, tall = (max(1, round(np.linalg.norm(v) / STEP)) for v in (first, second))
    u, v = np.meshgrid(np.linspace(0, 1, wide + 1), np.linspace(0, 1, tall + 1))
    points = corner + u.reshape(-1, 1) * first + v.reshape(-1, 1) * second
    number = np.arange(len(points)).reshape(u.shape)
    a, b, c, d = (x.ravel() for x in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return trimesh.Trimesh(points, faces, vertex_colors=np.tile([*color, 255], (len(points), 1)), process=False)


def box(low: tuple, high: tuple, color: tuple) -> list[trimesh.Trimesh]:
    """Sides and top of what stands on the floor."""
    (x, y, z), (a, b, c) = low, np.subtract(high, low)
    sides = [((x, y, z), (a, 0, 0), (0, 0, c)), ((x + a, y, z), (0, b, 0), (0, 0, c))]
    sides += [((x + a, y + b, z), (-a, 0, 0), (0, 0, c)), ((x, y + b, z), (0, -b, 0), (0, 0, c))]
    return [sheet(*side, color) for side in [*sides, ((x, y, z + c), (a, 0, 0), (0, b, 0))]]


def room(degrees: float = 0.0) -> tuple[MeshArrays, NDArray[np.int64]]:
    """Floor and three walls of 4 x 5 x 2.5, a red table, a blue chair of another class, a green picture: a mesh, and
    of each vertex the thing: 0 none, 1 table, 2 chair, 3 picture. All are called wall, or else."""
    red, blue, green = (170, 40, 40), (40, 40, 190), (30, 150, 30)
    parts = [sheet((0, 0, 0), (4, 0, 0), (0, 5, 0), (120, 90, 60)), sheet((0, 0, 0), (0, 0, 2.5), (0, 5, 0))]
    parts += [sheet((4, 0, 0), (0, 5, 0), (0, 0, 2.5)), sheet((0, 5, 0), (0, 0, 2.5), (4, 0, 0))]
    parts += box((1, 1, 0), (2.5, 1.8, 0.7), red) + box((3, 3, 0), (3.5, 3.5, 0.9), blue)
    of_part = np.repeat(np.repeat([0, 1, 2], [4, 5, 5]), [len(p.vertices) for p in parts])
    mesh = trimesh.util.concatenate(parts)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3].copy()
    x, y, z = mesh.vertices.T
    picture = (of_part == 0) & (x < 1e-6) & (np.abs(y - 2.5) < 0.41) & (np.abs(z - 1.5) < 0.31)
    colors[picture], thing = green, np.where(picture, 3, of_part)
    labels = np.where(thing == 2, 2, np.where((z < 1e-6) & (thing == 0), 1, 0)).astype(np.uint8)
    # The marching cubes' mesh is one piece: what stands on the floor shares vertices with it.
    _, first, one = np.unique(np.round(mesh.vertices / STEP * 4), axis=0, return_index=True, return_inverse=True)
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), (0, 0, 1))[:3, :3]
    points = (mesh.vertices[first] @ turn.T).astype(np.float32)
    faces = one.reshape(-1)[mesh.faces].astype(np.int32)
    return MeshArrays(points, faces, colors[first].astype(np.uint8), labels[first]), thing[first]


@pytest.mark.parametrize("degrees", [0.0, 33.0])
def test_things_are_found_whatever_the_network_calls_them(degrees: float) -> None:
    mesh, true = room(degrees)
    found = find_things(mesh, NAMES, True)
    assert found.max() == 2
    for thing in (1, 2, 3):
        overlaps = [((found == n) & (true == thing)).sum() / ((found == n) | (true == thing)).sum() for n in range(3)]
        assert 0.75 < max(overlaps) <= 1, f"thing {thing}: {overlaps}"
    assert (found[true == 0] < 0).mean() > 0.97
    assert (find_things(mesh, NAMES, True) == found).all()
    by_class = find_things(mesh, NAMES, False)  # without up, what is called wall is one
    assert by_class.max() == 0
    assert (true[by_class == 0] == 2).mean() > 0.9


def test_a_bare_wall_that_is_called_a_curtain_is_none() -> None:
    mesh, true = room()
    wall = (true == 0) & (mesh.vertices[:, 1] > 5 - 1e-4) & (mesh.vertices[:, 2] > 0.1)
    before = find_things(mesh, NAMES, True)
    called = replace(mesh, labels=np.where(wall, 3, mesh.labels).astype(np.uint8))
    assert (find_things(called, (*NAMES[:3], "curtain"), True) == before).all()
    assert (find_things(called, (*NAMES[:3], "wardrobe"), True)[wall] >= 0).mean() > 0.9


def test_they_are_described_in_the_unit_and_in_metres() -> None:
    mesh, _ = room(33.0)
    things = things_in(mesh, NAMES, UPRIGHT, [])
    assert sorted(t.name for t in things.table) == ["chair 1", "object 1", "picture 1"]
    table = next(t for t in things.table if t.name == "object 1")
    np.testing.assert_allclose(table.size, (1.5, 0.8, 0.7), atol=1.5 * STEP)
    direction = np.degrees(np.arctan2(table.axes[0][1], table.axes[0][0])) % 180
    assert direction == pytest.approx(33, abs=3)
    chair = next(t for t in things.table if t.name == "chair 1")
    assert (chair.label, chair.class_share > 0.8, table.label) == (2, True, 255)
    picture = next(t for t in things.table if t.name == "picture 1")
    assert 0 < picture.sure < chair.sure < 1
    assert chair.called_text.endswith("%")
    assert (picture.called_text, table.called_text) == ("by shape", "-")
    double = in_metres(things.table, 2.0, 0.1)[table.number - 1]
    assert double.metres == pytest.approx(2 * np.array(table.size))
    assert double.metres_sd[0] == pytest.approx(np.hypot(2 * table.size_sd[0], 0.1 * double.metres[0]), rel=1e-3)
    assert " m ± 1" in double.size_text
    assert " units ± " in table.size_text
    assert inventory_csv(things.table).count("\n") == 4


def test_numbers_and_names_stay_when_things_come_and_go() -> None:
    mesh, true = room()
    before = things_in(mesh, NAMES, UPRIGHT, [])
    number = {t.name: t.number for t in before.table}
    renamed = [replace(t, number=t.number + 10, name="chair 7") if t.name == "chair 1" else t for t in before.table]
    old = [t for t in renamed if t.name != "object 1"]
    after = things_in(mesh, NAMES, UPRIGHT, [], old)
    now = {t.name: t.number for t in after.table}
    assert now["chair 7"] == number["chair 1"] + 10
    assert now["picture 1"] == number["picture 1"]
    assert set(now) == {"chair 7", "picture 1", "object 1"}
    assert now["object 1"] not in (now["chair 7"], now["picture 1"])
    assert set(np.unique(after.numbers[true == 2])) <= {0, now["chair 7"]}
    gone = mesh.faces[(true[mesh.faces] != 1).all(axis=1)]
    fewer = things_in(replace(mesh, faces=gone), NAMES, UPRIGHT, [], before.table)
    assert {t.name: t.number for t in fewer.table} == {k: v for k, v in number.items() if k != "object 1"}


def test_the_floor_goes_on_where_a_thing_stood() -> None:
    mesh, true = room()
    under = (np.abs(mesh.vertices[:, 2]) < 1e-6) & (true != 1) & _inside(mesh.vertices, (1, 1), (2.5, 1.8))
    bare = mesh.faces[~under[mesh.faces].any(axis=1)]  # no camera sees the floor below the table
    mesh = replace(mesh, faces=bare)
    things = things_in(mesh, NAMES, UPRIGHT, [])
    table = next(t for t in things.table if t.name == "object 1")
    left, numbers = cut_mesh(mesh, things.numbers, Selection(frozenset({table.number}), frozenset(), False), UPRIGHT)
    assert table.number not in numbers
    middles, normals = _faces(left)
    here = _inside(middles, (1.1, 1.1), (2.4, 1.7))
    assert here.any()
    assert np.abs(middles[here, 2]).max() < 0.01, "nothing of the table is left"
    assert normals[here, 2].min() > 0.99
    cells = np.unique(np.floor(middles[here, :2] / (3 * STEP)), axis=0)
    assert len(cells) > 0.9 * (1.3 / (3 * STEP)) * (0.6 / (3 * STEP)), "the floor is closed"
    assert np.abs(left.colors[left.faces[here]].reshape(-1, 3).mean(0) - (120, 90, 60)).max() < 12
    only, numbers = cut_mesh(mesh, things.numbers, Selection(frozenset({table.number}), frozenset(), True), UPRIGHT)
    assert set(numbers.tolist()) <= {0, table.number}
    assert _inside(only.vertices, (0.8, 0.8), (2.7, 2.0)).all()


def _inside(points: NDArray, low: tuple, high: tuple) -> NDArray[np.bool_]:
    return np.asarray(((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1))


def _faces(mesh: MeshArrays) -> tuple[NDArray, NDArray]:
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(axis=1), cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)


@pytest.fixture
def run(oracle_run: OracleRun) -> RunFolder:
    """A run whose export holds the mesh of `room`, about a map of another place."""
    run = oracle_run()
    mesh, _ = room()
    things, folder = things_in(mesh, NAMES, UPRIGHT, []), run.stage("export")
    folder.mkdir(exist_ok=True)
    THINGS.save(folder, things.table)
    WORLD.save(folder, UPRIGHT)
    vertices = [(mesh.vertices, mesh.colors, mesh.labels)]
    blocks = MeshBlocks(len(mesh.vertices), len(mesh.faces), lambda: vertices, lambda: [mesh.faces])
    write_mesh_ply(folder / "mesh.ply", blocks, NAMES, things.numbers)
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    return run


def test_some_are_exported_and_others_left_out(run: RunFolder, tmp_path: Path) -> None:
    export_run(run, tmp_path / "a", "mesh", without="Chair 1, picture")
    numbers, table = read_mesh_things(tmp_path / "a" / "mesh.ply"), THINGS.read(tmp_path / "a" / "things.json")
    assert [t.name for t in table] == ["object 1"]
    assert set(numbers.tolist()) == {0, table[0].number}
    export_run(run, tmp_path / "b", "mesh", only_things="chair")
    mesh = read_mesh_ply(tmp_path / "b" / "mesh.ply")
    assert _inside(mesh.vertices, (2.8, 2.8), (3.7, 3.7)).all()
    export_run(run, tmp_path / "c", "ply", without="object 1")
    whole = len(msgs_slam.open_run(run.root).gaussians)
    kept = plyfile.PlyData.read(tmp_path / "c" / "point_cloud.ply")["vertex"]
    assert "thing" in kept.data.dtype.names
    assert 0 < len(kept.data) <= whole + 10_000
    both = {"without": "chair", "only_things": "chair"}
    for bad, said in (({"without": "unicorn"}, "no unicorn; there are"), (both, "exclude")):
        with pytest.raises(InputError, match=said):
            export_run(run, tmp_path / "d", "mesh", **bad)
    with pytest.raises(InputError, match="tum holds no things"):
        export_run(run, tmp_path / "d", "tum", without="chair")
    assert not (tmp_path / "d").exists()


def test_the_command_lists_them(run: RunFolder) -> None:
    shown = CliRunner().invoke(main, ["list", str(run.root)])
    assert shown.exit_code == 0
    assert "chair 1" in shown.output
    told = json.loads(CliRunner().invoke(main, ["list", str(run.root), "--json"]).output)
    assert {t["name"] for t in told} == {"chair 1", "object 1", "picture 1"}
    table = CliRunner().invoke(main, ["list", str(run.root), "--csv"]).output.splitlines()
    assert table[0].startswith("number,name,width")
    assert len(table) == 4


@pytest.mark.parametrize(
    "changed",
    [{"number": 10**12}, {"number": 0}, {"name": "chair"}, {"name": "chair \x1b[2J 1"}, {"label": 300}, {"faces": -1},
     {"center": [0, 0]}, {"axes": [[1, 0, 0]]}, {"size": [1e30, 1, 1]}, {"metres": [1.0]}],
)  # fmt: skip
def test_a_list_of_another_hand_is_refused(run: RunFolder, tmp_path: Path, changed: dict[str, object]) -> None:
    rows = json.loads(run.file("export", "things.json").read_text())
    table = tmp_path / "things.json"
    table.write_text(json.dumps(rows))
    THINGS.read(table)
    table.write_text(json.dumps([rows[0] | changed, *rows[1:]]))
    with pytest.raises(InputError, match="things"):
        THINGS.read(table)


def test_python_gives_each_its_mesh_and_its_gaussians(run: RunFolder) -> None:
    things = msgs_slam.open_run(run.root).things
    chair = next(t for t in things if t.name == "chair 1")
    assert _inside(chair.mesh().vertices, (2.8, 2.8), (3.7, 3.7)).all()
    assert len(chair.mesh().faces) > 200
    assert len(chair.gaussians()) < len(msgs_slam.open_run(run.root).gaussians)


def test_python_cuts_each_out_of_the_keyframes(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen from over the table, from under the floor, which hides all of it, and from near."""
    opened = msgs_slam.open_run(run.root)
    chair = next(t for t in opened.things if t.name == "chair 1")
    outcome = opened._outcome
    t, posed = outcome.trajectory, np.zeros_like(outcome.trajectory.is_keyframe)
    poses, cameras = t.cam_from_world.copy(), ((1.0, 3.2, 1.2), (1.0, 3.2, -1.0), (2.9, 3.2, 0.8))
    posed[: len(cameras)] = True
    for row, eye in enumerate(cameras):
        forward = np.array([3.25, 3.25, 0.45]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0, 0, 1.0))
        right /= np.linalg.norm(right)
        poses[row, :3, :3] = (right, np.cross(forward, right), forward)
        poses[row, :3, 3] = -poses[row, :3, :3] @ eye
    moved = replace(outcome, trajectory=replace(t, cam_from_world=poses, is_keyframe=posed))
    monkeypatch.setitem(vars(opened), "_outcome", moved)
    shown = chair.pictures()
    assert [name for name, _, _ in shown] == [outcome.frames[2].name, outcome.frames[0].name]
    (_, image, near), (_, _, far) = shown
    assert image.shape == (*near.shape, 3)
    assert 1.2 < near.sum() / far.sum() < 50
    rows, columns = np.nonzero(far)
    assert rows.min() <= 12, "cut out around it"
    assert columns.min() <= 12, "cut out around it"
    assert 0.5 < far[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].mean() <= 1
    assert chair.pictures(1)[0][0] == shown[0][0]


def test_a_lighter_mesh_has_a_node_for_each(run: RunFolder, tmp_path: Path) -> None:
    export_run(run, tmp_path, "mesh")
    mesh = read_mesh_glb(tmp_path / "mesh.glb")
    table = THINGS.read(tmp_path / "things.json")
    assert mesh.things is not None
    assert set(mesh.things.tolist()) <= {0, *(t.number for t in table)}
    assert set(mesh.things.tolist()) == set(read_mesh_things(tmp_path / "mesh.ply").tolist())
    names = set(trimesh.load(tmp_path / "mesh.glb").graph.nodes_geometry)
    assert {t.name for t in table} <= {name.removesuffix(", hidden") for name in names}


@pytest.mark.parametrize("kind", [row.kind for row in EXPORTS if row.holds_things and row.kind != "usd"])
def test_every_kind_that_holds_things_can_do_without(run: RunFolder, tmp_path: Path, kind: str) -> None:
    paths = export_run(run, tmp_path, kind, without="chair")
    assert len(paths) > 2
    assert all(path.exists() for path in paths)
    if kind == "collision":
        points = trimesh.load(tmp_path / "collision.glb", force="mesh").vertices[:, [0, 2]] * (1, -1)
        chair = (points > 3.05).all(axis=1) & (points < 3.45).all(axis=1)
        heights = trimesh.load(tmp_path / "collision.glb", force="mesh").vertices[chair, 1]
        assert np.abs(heights).max(initial=0) < 0.02


def test_a_damaged_mesh_takes_its_things_along_and_nothing_else(
    run: RunFolder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (run.stage("export") / "mesh.ply").write_bytes(b"ply")
    export_run(run, tmp_path / "a", "ply")
    assert "without its things: " in caplog.text
    assert "thing" not in plyfile.PlyData.read(tmp_path / "a" / "point_cloud.ply")["vertex"].data.dtype.names
    with pytest.raises(InputError, match=r"mesh\.ply is not as the program left it"):
        export_run(run, tmp_path / "b", "ply", without="chair")
