"""Textured meshes: trimesh and pygltflib read what we write, with the texture where it belongs."""

import io
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image

from msgs_slam.formats.mesh import TexturedMesh, write_textured_glb, write_textured_obj

COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8)


@pytest.fixture
def square() -> TexturedMesh:
    """Two triangles in two charts; each vertex's corner lies on a patch of that vertex's colour."""
    texture = np.zeros((32, 64, 3), np.uint8)
    texture[:16, :32], texture[:16, 32:], texture[16:, :32], texture[16:, 32:] = COLORS
    spots = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], np.float32)
    corner_vertex = np.array([0, 1, 2, 1, 3, 2])
    vertices = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], np.float32)
    labels, faces = np.array([1, 0, 1, 255], np.uint8), np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    return TexturedMesh(vertices, labels, corner_vertex, spots[corner_vertex], faces, texture)


def test_obj_in_a_foreign_reader(tmp_path: Path, square: TexturedMesh) -> None:
    paths = write_textured_obj(tmp_path / "room.obj", square, ("floor", "white wall"))
    assert [p.name for p in paths] == ["room.obj", "room.mtl", "room.png"]
    text = paths[0].read_text()
    assert text.count("\nv ") == 4
    assert text.count("\nvt ") == 6
    assert [line for line in text.splitlines() if line.startswith("g ")] == ["g floor", "g white_wall"]
    mesh = trimesh.load(paths[0], process=False, force="mesh")
    assert mesh.area == pytest.approx(1)
    seen = mesh.visual.to_color().vertex_colors[:, :3]
    for vertex, color in zip(square.vertices, COLORS, strict=True):
        assert (seen[(mesh.vertices == vertex).all(1)] == color).all()
    again = write_textured_obj(tmp_path / "again" / "room.obj", square, ("floor", "white wall"))
    assert [a.read_bytes() for a in again] == [p.read_bytes() for p in paths]


def test_glb_in_foreign_readers(tmp_path: Path, square: TexturedMesh) -> None:
    path = tmp_path / "room.glb"
    write_textured_glb(path, square, ("floor", "wall"))
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    assert (mesh.faces == square.faces).all()
    np.testing.assert_array_equal(mesh.vertices, square.vertices[square.corner_vertex])
    seen = mesh.visual.to_color().vertex_colors[:, :3].astype(int)
    assert np.abs(seen - COLORS[square.corner_vertex]).max() <= 3  # a JPEG
    assert (mesh.vertex_attributes["_LABEL"].ravel() == square.labels[square.corner_vertex]).all()
    assert mesh.metadata["classes"] == ["floor", "wall"]
    gltf = pygltflib.GLTF2().load_binary(str(path))
    assert gltf.materials[0].extensions == {"KHR_materials_unlit": {}}
    view = gltf.bufferViews[gltf.images[0].bufferView]
    picture = Image.open(io.BytesIO(gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]))
    assert (picture.format, picture.size) == ("JPEG", (64, 32))
    assert all(v.byteOffset % 4 == 0 for v in gltf.bufferViews)


def test_wrong_arrays_are_refused(square: TexturedMesh) -> None:
    for change, message in (
        ({"faces": square.faces[:0]}, "no faces"),
        ({"faces": square.faces + 1}, "a corner is outside the 6"),
        ({"corner_vertex": square.corner_vertex + 1}, "a vertex is outside the 4"),
        ({"labels": square.labels[:2]}, "labels: got shape"),
    ):
        with pytest.raises(ValueError, match=message):
            TexturedMesh(**{**vars(square), **change})
