"""Meshes: trimesh, plyfile and pygltflib read what we write, with colours, labels and the texture where it belongs."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from PIL import Image

from msgs_slam.formats import ply as ply_table
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.glb import ClassMesh, read_mesh_glb, write_mesh_glb
from msgs_slam.formats.ply import MeshBlocks, mesh_blocks, read_mesh_ply, write_mesh_ply


@pytest.fixture
def sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """An icosphere with random colours, and labels by octant."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    rng = np.random.default_rng(0)
    labels = ((mesh.vertices > 0) @ [1, 2, 4]).astype(np.uint8)
    labels[0] = 255
    colors = rng.integers(0, 256, (len(mesh.vertices), 3)).astype(np.uint8)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), colors, labels


def blocks(vertices: np.ndarray, faces: np.ndarray, *rest: np.ndarray, at_once: int = 10**9) -> MeshBlocks:
    """The arrays in blocks of so many rows."""

    def cut(array: np.ndarray) -> list[np.ndarray]:
        return [array[start : start + at_once] for start in range(0, len(array), at_once)]

    def parts() -> Iterator[tuple[np.ndarray, ...]]:
        return zip(*map(cut, (vertices, *rest)), strict=True)

    return MeshBlocks(len(vertices), len(faces), parts, lambda: cut(faces))


def test_ply_round_trip_and_foreign_readers(tmp_path: Path, sphere: tuple) -> None:
    vertices, faces, colors, labels = sphere
    path = tmp_path / "mesh.ply"
    write_mesh_ply(path, blocks(*sphere), class_names=("wall", "two words"))
    ours = read_mesh_ply(path)
    for got, expected in zip((ours.vertices, ours.faces, ours.colors, ours.labels), sphere, strict=True):
        assert (got == expected).all()
    ply = plyfile.PlyData.read(str(path))
    assert ply["vertex"].data.dtype.names == ("x", "y", "z", "red", "green", "blue", "label")
    assert (ply["vertex"]["label"] == labels).all()
    assert ply.comments == ["class 0 wall", "class 1 two words"]
    loaded = trimesh.load_mesh(str(path), process=False)
    assert loaded.is_watertight
    assert (loaded.faces == faces).all()
    assert (loaded.visual.vertex_colors[:, :3] == colors).all()
    np.testing.assert_array_equal(loaded.vertices, vertices)


def test_any_class_name_is_kept_in_a_ply(tmp_path: Path, sphere: tuple) -> None:
    names = ("Küche", "element foo 3", "end_header")
    write_mesh_ply(tmp_path / "mesh.ply", blocks(*sphere), class_names=names)
    assert (read_mesh_ply(tmp_path / "mesh.ply").vertices == sphere[0]).all()
    assert sum(len(block) for block in mesh_blocks(tmp_path / "mesh.ply").faces()) == len(sphere[1])
    comments = plyfile.PlyData.read(str(tmp_path / "mesh.ply")).comments
    assert [c.encode().decode("unicode_escape").split(" ", 2)[2] for c in comments] == list(names)


def in_light(colors: np.ndarray) -> np.ndarray:
    """What glTF's COLOR_0 has to be of sRGB 0..255: linear (2.0, 3.9.2). trimesh gives its numbers as they are."""
    return 255 * np.where(colors <= 0.04045 * 255, colors / 255 / 12.92, ((colors / 255 + 0.055) / 1.055) ** 2.4)


def plain(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, labels: np.ndarray) -> ClassMesh:
    """With colours, every face of its first corner's class."""
    uv, nothing = np.zeros((len(vertices), 2), np.float32), np.zeros((0, 0, 3), np.uint8)
    return ClassMesh(vertices, colors, labels[faces[:, 0]], np.arange(len(vertices)), uv, faces, nothing)


def test_glb_has_a_node_a_class_in_foreign_readers(tmp_path: Path, sphere: tuple) -> None:
    vertices, faces, colors, labels = sphere
    path, names = tmp_path / "mesh.glb", tuple("abcdefgh")
    write_mesh_glb(path, mesh := plain(*sphere), names)
    scene = trimesh.load_scene(str(path), process=False)
    of_faces = labels[faces[:, 0]]
    assert set(scene.graph.nodes_geometry) == {*names, "unknown"} == set(scene.geometry)
    assert sum(len(part.faces) for part in scene.geometry.values()) == len(faces)
    row_of = {tuple(v): row for row, v in enumerate(vertices.tolist())}
    for name, part in scene.geometry.items():
        rows = np.array([row_of[tuple(v)] for v in np.asarray(part.vertices, np.float32).tolist()])
        label = 255 if name == "unknown" else names.index(name)
        np.testing.assert_array_equal(rows[part.faces], faces[of_faces == label])
        np.testing.assert_allclose(255 * part.visual.vertex_attributes["color"][:, :3], in_light(colors[rows]), atol=1)
        assert (part.vertex_attributes["_LABEL"] == label).all()
        assert part.metadata["classes"] == list(names)
        assert ((part.vertex_normals * vertices[rows]).sum(axis=1) > 0.99).all()
    assert colors.std() > 5
    (material,) = pygltflib.GLTF2().load_binary(str(path)).materials
    assert material.doubleSided
    assert (material.pbrMetallicRoughness.metallicFactor, material.pbrMetallicRoughness.roughnessFactor) == (0, 1)
    assert "KHR_materials_unlit" in material.extensions
    again = read_mesh_glb(path)
    assert sorted(again.labels) == sorted(of_faces)
    corners = [(m.vertices[m.corner_vertex], m.colors[m.corner_vertex]) for m in (again, mesh)]
    np.testing.assert_array_equal(*(np.unique(np.column_stack(both), axis=0) for both in corners))


def test_the_same_mesh_gives_the_same_bytes_in_blocks_of_any_size(tmp_path: Path, sphere: tuple) -> None:
    write_mesh_ply(tmp_path / "a" / "m.ply", blocks(*sphere))
    write_mesh_ply(tmp_path / "b" / "m.ply", blocks(*sphere, at_once=100))
    assert (tmp_path / "a" / "m.ply").read_bytes() == (tmp_path / "b" / "m.ply").read_bytes()


def test_meshes_that_are_not_our_own_are_refused(tmp_path: Path, sphere: tuple) -> None:
    write_mesh_ply(tmp_path / "whole.ply", blocks(*sphere))
    data = (tmp_path / "whole.ply").read_bytes()
    other = trimesh.creation.box().export(file_type="ply")
    for content in (*(data[:keep] for keep in (2, 40, 300, len(data) - 1)), other, data[:-4] + b"\xff\xff\xff\x7f"):
        (tmp_path / "cut.ply").write_bytes(content)
        with pytest.raises(InputError, match="export it again"):
            read_mesh_ply(tmp_path / "cut.ply")


def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, sphere: tuple) -> None:
    vertices, faces, colors, labels = sphere
    for arguments in [(vertices, faces, colors[:-1], labels), (vertices, faces, colors, labels[:, None])]:
        with pytest.raises(ValueError, match="MeshArrays"):
            write_mesh_ply(tmp_path / "m.ply", blocks(*arguments))
    with pytest.raises(ValueError, match="outside"):
        write_mesh_ply(tmp_path / "m.ply", blocks(vertices, faces + 1, colors, labels))
    for counts in ((len(vertices) - 1, len(faces)), (len(vertices), len(faces) + 1)):
        short = MeshBlocks(*counts, lambda: [(vertices, colors, labels)], lambda: [faces[:-1]])
        with pytest.raises(ValueError, match=r"missing|outside"):
            write_mesh_ply(tmp_path / "m", short)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="no faces"):
        plain(vertices, faces[:0], colors, labels)
    write_mesh_ply(tmp_path / "empty.ply", blocks(vertices[:0], faces[:0], colors[:0], labels[:0]))
    assert len(read_mesh_ply(tmp_path / "empty.ply").faces) == 0
    assert list(mesh_blocks(tmp_path / "empty.ply").vertices()) == []


def test_a_ply_is_read_in_blocks(tmp_path: Path, sphere: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply_table, "_ROWS", 100)
    write_mesh_ply(tmp_path / "m.ply", blocks(*sphere), ("wall",))
    mesh = mesh_blocks(tmp_path / "m.ply")
    assert [len(faces) for faces in mesh.faces()] == [100] * 12 + [80]
    (tmp_path / "m.ply").write_bytes((tmp_path / "m.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match="export it again"):
        mesh_blocks(tmp_path / "m.ply")


COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8)


@pytest.fixture
def square() -> ClassMesh:
    """Two triangles in two charts; each vertex's corner lies on a patch of that vertex's colour."""
    texture = np.zeros((32, 64, 3), np.uint8)
    texture[:16, :32], texture[:16, 32:], texture[16:, :32], texture[16:, 32:] = COLORS
    spots = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], np.float32)
    corner_vertex = np.array([0, 1, 2, 1, 3, 2])
    vertices = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], np.float32)
    labels, faces = np.array([1, 1], np.uint8), np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    return ClassMesh(vertices, COLORS, labels, corner_vertex, spots[corner_vertex], faces, texture)


def test_glb_in_foreign_readers(tmp_path: Path, square: ClassMesh) -> None:
    path = tmp_path / "room.glb"
    write_mesh_glb(path, square, ("floor", "wall"))
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    assert (mesh.faces == square.faces).all()
    np.testing.assert_array_equal(mesh.vertices, square.vertices[square.corner_vertex])
    seen = mesh.visual.to_color().vertex_colors[:, :3].astype(int)
    assert np.abs(seen - COLORS[square.corner_vertex]).max() <= 3  # a JPEG
    assert (mesh.vertex_attributes["_LABEL"] == 1).all()
    np.testing.assert_array_equal(mesh.vertex_normals, square.normals[square.corner_vertex])
    assert mesh.metadata["classes"] == ["floor", "wall"]
    gltf = pygltflib.GLTF2().load_binary(str(path))
    assert gltf.materials[0].extensions == {"KHR_materials_unlit": {}}
    view = gltf.bufferViews[gltf.images[0].bufferView]
    picture = Image.open(io.BytesIO(gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]))
    assert (picture.format, picture.size) == ("JPEG", (64, 32))
    assert all(v.byteOffset % 4 == 0 for v in gltf.bufferViews)


def test_wrong_arrays_are_refused(square: ClassMesh) -> None:
    for change, message in (
        ({"faces": square.faces[:0]}, "no faces"),
        ({"faces": square.faces + 1}, "a corner is outside the 6"),
        ({"corner_vertex": square.corner_vertex + 1}, "a vertex is outside the 4"),
        ({"labels": square.labels[:1]}, "labels: got shape"),
    ):
        with pytest.raises(ValueError, match=message):
            ClassMesh(**{**vars(square), **change})
