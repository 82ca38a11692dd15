"""Labelled triangle meshes in PLY and GLB, and textured ones in GLB."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .glb import LABEL, UNLIT, Part, glb_parts, linear, material, write_primitive
from .images import decode_rgb, jpeg_bytes
from .ply import Rows, read_ply_rows, write_ply
from .reading import parsing, read_bytes
from .trajectory import FARTHEST

_LINEAR, _MIPMAPPED, _CLAMPED = 9729, 9987, 33071

_PLACE, _COLOR = ("x", "y", "z"), ("red", "green", "blue")
_VERTEX = np.dtype([*((n, "<f4") for n in _PLACE), *((n, "u1") for n in (*_COLOR, "label"))])
_FACE = np.dtype([("vertex_indices", "<i4", (3,))])
_LISTED = {"vertex": _VERTEX, "face": np.dtype([("length", "u1"), *_FACE.descr])}


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """vertices (V, 3) float32, faces (F, 3) int32, colors (V, 3) uint8, labels (V,) uint8 (255 = no class)."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8]
    labels: NDArray[np.uint8]

    def __post_init__(self) -> None:
        v = len(self.vertices)
        expected = {"vertices": (v, 3), "faces": (len(self.faces), 3), "colors": (v, 3), "labels": (v,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"MeshArrays: {name}: got shape {getattr(self, name).shape}, expected {shape}")
        if len(self.faces) and not 0 <= self.faces.min() <= self.faces.max() < v:
            raise ValueError(f"MeshArrays: a face points outside the {v} vertices")
        if not (np.abs(self.vertices) < FARTHEST).all():
            raise ValueError("MeshArrays: a vertex is not finite, or too far away")


@dataclass(frozen=True)
class MeshBlocks:
    """A mesh of which only a part is in memory at a time. `vertices` and `faces` go over it anew whenever they are
    called: blocks of positions (n, 3) float32, colors (n, 3) uint8, labels (n,) uint8; and of faces (n, 3) int32."""

    vertex_count: int
    face_count: int
    vertices: Callable[[], Iterable[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]]]
    faces: Callable[[], Iterable[NDArray[np.int32]]]


def write_mesh_ply(path: Path, mesh: MeshBlocks, class_names: tuple[str, ...] = ()) -> None:
    """Write a binary PLY with x y z, red green blue and the extra property label (uchar) at each vertex.

    Class names go to comments. Raises ValueError for blocks that do not fit, InputError when the disk refuses.
    """
    count, no_faces = mesh.vertex_count, np.zeros((0, 3), np.int32)
    vertices = (_vertex_rows(MeshArrays(points, no_faces, *rest)) for points, *rest in mesh.vertices())
    elements = {
        "vertex": Rows(_VERTEX, count, vertices),
        "face": Rows(_FACE, mesh.face_count, (_face_rows(faces, count) for faces in mesh.faces())),
    }
    write_ply(path, elements, [f"class {i} {name}" for i, name in enumerate(class_names)])


def _vertex_rows(mesh: MeshArrays) -> NDArray[Any]:
    rows = np.empty(len(mesh.vertices), _VERTEX)
    for names, values in ((_PLACE, mesh.vertices), (_COLOR, mesh.colors)):
        for i, name in enumerate(names):
            rows[name] = values[:, i]
    rows["label"] = mesh.labels
    return rows


def _face_rows(faces: NDArray[np.int32], count: int) -> NDArray[Any]:
    if faces.shape[1:] != (3,) or (len(faces) and not 0 <= faces.min() <= faces.max() < count):
        raise ValueError(f"MeshBlocks: a face is no triangle, or points outside the {count} vertices")
    rows = np.empty(len(faces), _FACE)
    rows["vertex_indices"] = faces
    return rows


def mesh_blocks(path: Path) -> MeshBlocks:
    """Return the mesh of a PLY by `write_mesh_ply`. Raises InputError for another file."""
    vertex, face = read_ply_rows(path, _LISTED).values()

    def vertices() -> Iterator[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]]:
        for rows in vertex.blocks:
            points, colors = (np.stack([rows[n] for n in names], 1) for names in (_PLACE, _COLOR))
            yield points, colors, rows["label"]

    return MeshBlocks(vertex.count, face.count, vertices, lambda: (rows["vertex_indices"] for rows in face.blocks))


def read_mesh_ply(path: Path) -> MeshArrays:
    """Read a mesh by `write_mesh_ply`. Raises InputError for another file."""
    vertex, face = (np.concatenate([np.zeros(0, r.dtype), *r.blocks]) for r in read_ply_rows(path, _LISTED).values())
    points, colors = (np.stack([vertex[n] for n in names], 1) for names in (_PLACE, _COLOR))
    with parsing(path, "mesh", "export it again"):
        return MeshArrays(points, np.ascontiguousarray(face["vertex_indices"]), colors, vertex["label"].copy())


def write_mesh_glb(
    path: Path, mesh: MeshBlocks, class_names: tuple[str, ...] = (), gltf_from_world: NDArray[np.float64] | None = None
) -> None:
    """Write an unlit GLB with vertex colours, the labels as vertex attribute _LABEL, class names in the mesh's extras.

    gltf_from_world (3, 3) turns the vertices: glTF wants y up. Errors as `write_mesh_ply`, ValueError for no faces.
    """
    if not mesh.face_count:
        raise ValueError("write_mesh_glb: glTF has no way to store a mesh without faces")
    turn = np.eye(3) if gltf_from_world is None else gltf_from_world.T

    def positions() -> Iterator[NDArray[np.float32]]:
        return ((points @ turn).astype(np.float32) for points, _, _ in mesh.vertices() if len(points))

    ends = np.array([(points.min(0), points.max(0)) for points in positions()])
    box = {"min": ends[:, 0].min(0).tolist(), "max": ends[:, 1].max(0).tolist()}
    colors = (linear(colors / 255) for _, colors, _ in mesh.vertices())
    parts = [
        Part("POSITION", mesh.vertex_count, 3, "<f4", positions(), box),
        Part("COLOR_0", mesh.vertex_count, 3, "<f4", colors),
        # glTF wants every vertex at a multiple of 4 bytes: a float per label instead of a byte
        Part(LABEL, mesh.vertex_count, 1, "<f4", (labels for _, _, labels in mesh.vertices())),
        Part("", 3 * mesh.face_count, 1, "<u4", mesh.faces()),
    ]
    primitive, extras = {"mode": 4, "material": 0}, {"materials": [material()]}
    write_primitive(path, parts, primitive, class_names, {"name": "mesh"}, extras, [UNLIT])


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """vertices (V, 3) float32, labels (V,) uint8 (255 = no class), texture (H, W, 3) uint8.

    corner_vertex (K,) int64 and corner_uv (K, 2) float32: a vertex has as many corners as charts meet there; u to the
    right and v downwards from the texture's top left, 0..1. faces (F, 3) int32 are corners.
    """

    vertices: NDArray[np.float32]
    labels: NDArray[np.uint8]
    corner_vertex: NDArray[np.int64]
    corner_uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]

    def __post_init__(self) -> None:
        v, k = len(self.vertices), len(self.corner_vertex)
        expected = {"vertices": (v, 3), "labels": (v,), "corner_uv": (k, 2), "faces": (len(self.faces), 3)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"TexturedMesh: {name}: got shape {getattr(self, name).shape}, expected {shape}")
        if not len(self.faces):
            raise ValueError("TexturedMesh: it has no faces")
        for name, indices, most in (("corner", self.faces, k), ("vertex", self.corner_vertex, v)):
            if not 0 <= indices.min() <= indices.max() < most:
                raise ValueError(f"TexturedMesh: a {name} is outside the {most} there are")


def write_textured_glb(path: Path, mesh: TexturedMesh, class_names: tuple[str, ...] = ()) -> None:
    """Write a GLB with the texture as a JPEG, shown as it is (KHR_materials_unlit), labels as attribute _LABEL.

    glTF wants y up: the caller turns the vertices. The same mesh gives the same bytes. Raises InputError when the disk
    refuses.
    """
    parts = [
        Part.of("POSITION", mesh.vertices[mesh.corner_vertex]),
        Part.of("TEXCOORD_0", mesh.corner_uv),
        Part.of(LABEL, mesh.labels[mesh.corner_vertex].astype(np.float32)),
        Part.of("", mesh.faces.reshape(-1).astype(np.uint32)),
    ]
    extras = {
        "materials": [material(baseColorTexture={"index": 0})],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPPED, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
        "images": [{"bufferView": len(parts), "mimeType": "image/jpeg"}],
    }
    picture = jpeg_bytes(mesh.texture)
    write_primitive(path, parts, {"material": 0}, class_names, {"name": "mesh"}, extras, [UNLIT], picture)


def has_texture(path: Path) -> bool:
    """Return whether a mesh by `write_textured_glb` or `write_mesh_glb` has a texture. Raises InputError for another
    file."""
    with parsing(path, "mesh", "export it again"):
        return "textures" in glb_parts(read_bytes(path))[0]


def read_textured_glb(path: Path) -> TexturedMesh | None:
    """Read a mesh by `write_textured_glb`, every corner a vertex of its own; None where it has no texture, as those by
    `write_mesh_glb`. Raises InputError for another file."""
    data = read_bytes(path)
    with parsing(path, "mesh", "export it again"):
        document, binary = glb_parts(data)
        if "textures" not in document:
            return None
        parts = [binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in document["bufferViews"]]
        places, uv, labels = (np.frombuffer(part, "<f4") for part in parts[:3])
        faces = np.frombuffer(parts[3], "<u4").reshape(-1, 3).astype(np.int32)
        own = np.arange(len(labels))
        picture = decode_rgb(parts[4], str(path))
        return TexturedMesh(places.reshape(-1, 3), labels.astype(np.uint8), own, uv.reshape(-1, 2), faces, picture)
