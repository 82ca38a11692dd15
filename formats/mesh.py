"""Labelled triangle meshes in PLY and GLB."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from formats.glb import write_glb
from formats.ply_table import columns, read_ply, write_ply
from formats.reading import parsing, read_bytes
from formats.trajectory import FARTHEST

_LABEL_ATTRIBUTE = "_LABEL"
_MAX_GLB_BYTES = 4 * 1024**3
_BYTE, _UNSIGNED, _FLOAT = 5121, 5125, 5126


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


def write_mesh_ply(
    path: Path,
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    class_names: tuple[str, ...] = (),
) -> None:
    """Write a binary PLY with x y z, red green blue and the extra property label (uchar) at each vertex.

    vertices (V, 3), faces (F, 3), colors (V, 3) uint8, labels (V,) uint8; class names go to comments. Raises
    ValueError for other shapes, InputError when the disk refuses.
    """
    mesh = MeshArrays(vertices, faces, colors, labels)
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("label", "u1")]
    vertex = np.empty(len(vertices), dtype=fields)
    for i, name in enumerate(("x", "y", "z")):
        vertex[name] = mesh.vertices[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        vertex[name] = mesh.colors[:, i]
    vertex["label"] = mesh.labels
    face = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = mesh.faces
    comments = [f"class {i} {name}" for i, name in enumerate(class_names)]
    write_ply(path, {"vertex": vertex, "face": face}, comments)


def read_mesh_ply(path: Path) -> MeshArrays:
    """A triangle mesh from a PLY by this or another program; polygons are cut into triangle fans.

    Vertices without colours are grey, without labels 255. Raises InputError for a file that is no mesh.
    """
    path = Path(path)
    ply = read_ply(path)
    if "vertex" not in ply or "face" not in ply:
        raise InputError(f"{path} has no faces: it is a point cloud or a splat file, not a mesh")
    vertex, face = ply["vertex"].data, ply["face"].data
    indices = next((n for n in ("vertex_indices", "vertex_index") if n in (face.dtype.names or ())), None)
    if indices is None:
        raise InputError(f"{path}: its faces have no vertex_indices: it is no mesh this program can read")
    names = vertex.dtype.names or ()
    count = len(vertex)
    has_colors = {"red", "green", "blue"} <= set(names)
    colors = columns(vertex, ["red", "green", "blue"], path) if has_colors else np.full((count, 3), 128, np.float32)
    colors = colors.clip(0, 255)
    labels = columns(vertex, ["label"], path)[:, 0].clip(0, 255) if "label" in names else np.full(count, 255)
    with parsing(path, "mesh", "export it again"):
        return MeshArrays(
            columns(vertex, ["x", "y", "z"], path), _triangles(face[indices], count), colors.astype(np.uint8),
            labels.astype(np.uint8),
        )  # fmt: skip


def write_mesh_glb(
    path: Path,
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    labels: NDArray[np.uint8],
    class_names: tuple[str, ...] = (),
) -> None:
    """Write a GLB with vertex colours, the labels as vertex attribute _LABEL, class names in the mesh's extras.

    Arguments and errors as `write_mesh_ply`. glTF wants y up: the caller turns the vertices.
    """
    mesh = MeshArrays(vertices, faces, colors, labels)
    if not len(mesh.faces):
        raise ValueError("write_mesh_glb: glTF has no way to store a mesh without faces")
    opaque = np.column_stack([mesh.colors, np.full(len(mesh.colors), 255, dtype=np.uint8)])
    low, high = mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()
    parts: list[tuple[str, NDArray[Any], int, dict[str, Any]]] = [
        ("POSITION", mesh.vertices.astype("<f4", copy=False), _FLOAT, {"type": "VEC3", "min": low, "max": high}),
        ("COLOR_0", opaque, _BYTE, {"type": "VEC4", "normalized": True}),
        # glTF wants every vertex at a multiple of 4 bytes: a float per label instead of a byte
        (_LABEL_ATTRIBUTE, mesh.labels.astype("<f4"), _FLOAT, {"type": "SCALAR"}),
        ("", mesh.faces.astype("<u4", copy=False), _UNSIGNED, {"type": "SCALAR"}),
    ]
    views, accessors, start = [], [], 0
    for i, (name, array, kind, more) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": 34962 if name else 34963})
        count = len(array) if name else array.size
        accessors.append({"bufferView": i, "componentType": kind, "count": count} | more)
        start += array.nbytes
    primitive = {"attributes": {name: i for i, (name, *_) in enumerate(parts) if name}, "indices": 3, "mode": 4}
    document = {
        "asset": {"version": "2.0", "generator": "msgs-slam"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "mesh"}],
        "meshes": [{"primitives": [primitive], "name": "mesh", "extras": {"classes": list(class_names)}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    write_glb(path, document, [array for _, array, *_ in parts])


def read_mesh_glb(path: Path) -> MeshArrays:
    """A mesh as `write_mesh_glb` wrote it. Raises InputError for a damaged file or one without triangles."""
    import trimesh

    data = read_bytes(path, _MAX_GLB_BYTES)
    with parsing(path, "GLB with a triangle mesh", "export it again"):
        _require_own_bytes(data)
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        mesh: Any = next(m for m in scene.geometry.values() if isinstance(m, trimesh.Trimesh))
        labels = mesh.vertex_attributes.get(_LABEL_ATTRIBUTE, np.full(len(mesh.vertices), 255))
        return MeshArrays(
            np.asarray(mesh.vertices, dtype=np.float32),
            np.asarray(mesh.faces, dtype=np.int32),
            np.asarray(mesh.visual.vertex_colors[:, :3], dtype=np.uint8),
            np.asarray(labels).reshape(-1).astype(np.uint8),
        )


def _require_own_bytes(data: bytes) -> None:
    """Raise ValueError unless the GLB's arrays all lie in it: a count alone would be filled with zeros."""
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length])
    accessors = header.get("accessors", [])
    if any("uri" in buffer for buffer in [*header.get("buffers", []), *header.get("images", [])]):
        raise ValueError("it names other files")
    if any("bufferView" not in a or "sparse" in a or a["count"] > len(data) for a in accessors):
        raise ValueError("an array of it is not in it")


def _triangles(polygons: NDArray, vertices: int) -> NDArray[np.int32]:
    """(F, 3) of faces given as an (F, n) array, or as n indices each in an array of objects; ValueError for others."""
    if polygons.dtype != object:
        listed = polygons.astype(np.int64)
        if listed.size and not 0 <= listed.min() <= listed.max() < vertices:
            raise ValueError(f"a face points outside the {vertices} vertices")
        fans = [listed[:, [0, i, i + 1]] for i in range(1, listed.shape[1] - 1)] if listed.ndim == 2 else []
        return np.concatenate(fans).astype(np.int32) if fans else np.zeros((0, 3), dtype=np.int32)
    counts = np.array([len(p) for p in polygons])
    parts = [_triangles(np.stack(list(polygons[counts == n])), vertices) for n in np.unique(counts) if n >= 3]
    return np.concatenate(parts).astype(np.int32) if parts else np.zeros((0, 3), dtype=np.int32)
