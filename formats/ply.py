"""PLY files: tables that are written and read in blocks; clouds of points and labelled meshes in them."""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import InputError
from .reading import opened, parsing
from .trajectory import FARTHEST

_MAX_HEADER_BYTES = 1 << 20
_ROWS = 1 << 18
"""That are written at once."""
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}

_PLACE, _NORMAL, _COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_POINT = np.dtype([*((n, "<f4") for n in (*_PLACE, *_NORMAL)), *((n, "u1") for n in _COLOR)])
_VERTEX = np.dtype([*((n, "<f4") for n in _PLACE), *((n, "u1") for n in (*_COLOR, "label"))])
_OF_THING = np.dtype([*_VERTEX.descr, ("thing", "<u2")])
_FACE = np.dtype([("vertex_indices", "<i4", (3,))])
_LISTED = np.dtype([("length", "u1"), *_FACE.descr])


@dataclass(frozen=True)
class Rows:
    """`count` rows of a structured `dtype`, of which no more than one of the `blocks` needs to be in memory. A field
    (n,) per row becomes a list property."""

    dtype: np.dtype
    count: int
    blocks: Iterable[NDArray[Any]]


def write_ply(path: Path, elements: dict[str, Rows], comments: list[str]) -> None:
    """Write a binary little-endian PLY, atomically.

    Raises ValueError where there are more or fewer rows than `count`, InputError when the disk refuses.
    """
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {' '.join(text.split())}" for text in comments)]
    for name, rows in elements.items():
        header += [f"element {name} {rows.count}", *_property_lines(rows.dtype)]
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii", errors="backslashreplace"))
        for name, rows in elements.items():
            left = rows.count
            for block in rows.blocks:
                file.write(_packed(block).data)
                left -= len(block)
            if left:
                raise ValueError(f"write_ply: {name}: {left} of {rows.count} rows are missing")


def slices(count: int) -> Iterator[slice]:
    """Split `count` rows into the slices that are written or read at once."""
    return (slice(start, min(start + _ROWS, count)) for start in range(0, count, _ROWS))


def _property_lines(dtype: np.dtype) -> list[str]:
    lines = []
    for name in dtype.names or ():
        base, shape = dtype[name].base, dtype[name].shape
        kind = f"list uchar {_NAMES[base.str[1:]]}" if shape else _NAMES[base.str[1:]]
        lines.append(f"property {kind} {name}")
    return lines


def _packed(array: NDArray[Any]) -> NDArray[Any]:
    """The rows as stored in the file: little-endian, without gaps, each list after its length."""
    fields: list[tuple] = []
    for name in array.dtype.names or ():
        base, shape = array.dtype[name].base.newbyteorder("<"), array.dtype[name].shape
        fields += [(f"{name} length", "u1"), (name, base, shape)] if shape else [(name, base)]
    packed = np.empty(len(array), dtype=fields)
    for name in array.dtype.names or ():
        packed[name] = array[name]
        if array.dtype[name].shape:
            packed[f"{name} length"] = array.dtype[name].shape[0]
    return packed


def write_point_ply(path: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
    """Write points (P, 3) and colors (P, 3) uint8 with normals of zero, which the original trainer insists on.

    Raises ValueError for shapes that do not fit, InputError when the disk refuses.
    """
    if points.shape != (len(colors), 3) or colors.shape != points.shape:
        raise ValueError(f"write_point_ply: got points {points.shape} and colors {colors.shape}, expected (P, 3) both")
    blocks = (_filled(_POINT, {_PLACE: points[rows], _COLOR: colors[rows]}) for rows in slices(len(points)))
    write_ply(path, {"vertex": Rows(_POINT, len(points), blocks)}, [])


def _filled(dtype: np.dtype, columns: dict[tuple[str, ...], NDArray[Any]]) -> NDArray[Any]:
    """Rows with these columns (n, names), and zeros in the others."""
    rows = np.zeros(len(next(iter(columns.values()))), dtype)
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    return rows


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

    def of_labels(self, labels: Iterable[int]) -> "MeshArrays":
        """Return the faces whose three vertices have one of these labels, and these vertices."""
        return self.of_vertices(np.isin(self.labels, list(labels)))

    def of_vertices(self, wanted: NDArray[np.bool_]) -> "MeshArrays":
        """Return the faces whose three vertices are wanted (V,), and these vertices."""
        faces = self.faces[wanted[self.faces].all(1)]
        used, corners = np.unique(faces, return_inverse=True)
        faces = corners.reshape(-1, 3).astype(np.int32)
        return MeshArrays(self.vertices[used], faces, self.colors[used], self.labels[used])


@dataclass(frozen=True)
class MeshBlocks:
    """A mesh of which only a part is in memory at a time. `vertices` and `faces` go over it anew whenever they are
    called: blocks of positions (n, 3) float32, colors (n, 3) uint8, labels (n,) uint8; and of faces (n, 3) int32. So do
    `things`, numbers (n,) of the vertices' things, where the mesh is a file's."""

    vertex_count: int
    face_count: int
    vertices: Callable[[], Iterable[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]]]
    faces: Callable[[], Iterable[NDArray[np.int32]]]
    things: Callable[[], Iterable[NDArray[np.uint16]]] = tuple


def write_mesh_ply(
    path: Path, mesh: MeshBlocks, class_names: tuple[str, ...] = (), things: NDArray[np.uint16] | None = None
) -> None:
    """Write a binary PLY with x y z, red green blue and the extra property label (uchar) at each vertex, and where
    `things` (V,) are given the number of its thing (ushort, 0 for none) as the property thing.

    Class names go to comments. Raises ValueError for blocks that do not fit, InputError when the disk refuses.
    """
    count, no_faces = mesh.vertex_count, np.zeros((0, 3), np.int32)
    kind = _VERTEX if things is None else _OF_THING

    def vertices() -> Iterator[NDArray[Any]]:
        start = 0
        for points, *rest in mesh.vertices():
            m = MeshArrays(points, no_faces, *rest)
            columns: dict[tuple[str, ...], NDArray[Any]] = {
                _PLACE: m.vertices,
                _COLOR: m.colors,
                ("label",): m.labels[:, None],
            }
            if things is not None:
                columns[("thing",)] = things[start : start + len(points), None]
            start += len(points)
            yield _filled(kind, columns)

    elements = {
        "vertex": Rows(kind, count, vertices()),
        "face": Rows(_FACE, mesh.face_count, (_face_rows(faces, count) for faces in mesh.faces())),
    }
    write_ply(path, elements, [f"class {i} {name}" for i, name in enumerate(class_names)])


def _face_rows(faces: NDArray[np.int32], count: int) -> NDArray[Any]:
    if faces.shape[1:] != (3,) or (len(faces) and not 0 <= faces.min() <= faces.max() < count):
        raise ValueError(f"MeshBlocks: a face is no triangle, or points outside the {count} vertices")
    return np.ascontiguousarray(faces, "<i4").view(_FACE).reshape(-1)


def mesh_blocks(path: Path) -> MeshBlocks:
    """Return the mesh of a PLY by `write_mesh_ply`; blocks are read lazily. Raises InputError for another file."""
    with opened(path) as file:
        head = file.read(_MAX_HEADER_BYTES)
    start = head.find(b"\nend_header\n") + len(b"\nend_header\n")
    counts = {m[1].decode(): int(m[2]) for m in re.finditer(rb"^element (\w+) (\d+)$", head[:start], re.MULTILINE)}
    vertex_count, face_count = (counts.get(name, 0) for name in ("vertex", "face"))
    kind = _OF_THING if b"\nproperty ushort thing\n" in head[:start] else _VERTEX
    faces_at = start + vertex_count * kind.itemsize
    if list(counts) != ["vertex", "face"] or faces_at + face_count * _LISTED.itemsize != Path(path).stat().st_size:
        raise InputError(f"{path} is not as this program writes it: export it again")

    def blocks(dtype: np.dtype, at: int, count: int) -> Iterator[NDArray[Any]]:
        with opened(path) as file:
            file.seek(at)
            for rows in slices(count):
                yield np.fromfile(file, dtype, rows.stop - rows.start)

    def vertices() -> Iterator[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]]:
        for rows in blocks(kind, start, vertex_count):
            points, colors = (np.stack([rows[n] for n in names], 1) for names in (_PLACE, _COLOR))
            yield points, colors, rows["label"].copy()

    def things() -> Iterator[NDArray[np.uint16]]:
        for rows in blocks(kind, start, vertex_count):
            yield rows["thing"].copy() if kind is _OF_THING else np.zeros(len(rows), np.uint16)

    def faces() -> Iterator[NDArray[np.int32]]:
        return (rows["vertex_indices"] for rows in blocks(_LISTED, faces_at, face_count))

    return MeshBlocks(vertex_count, face_count, vertices, faces, things)


def read_mesh_things(path: Path) -> NDArray[np.uint16]:
    """Read the numbers (V,) of the vertices' things, 0 for none. Raises InputError for another file."""
    return np.concatenate([np.zeros(0, np.uint16), *mesh_blocks(path).things()])


def read_mesh_ply(path: Path) -> MeshArrays:
    """Read a mesh by `write_mesh_ply`. Raises InputError for another file."""
    mesh = mesh_blocks(path)
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8)
    points, colors, labels = (np.concatenate(parts) for parts in zip(nothing, *mesh.vertices(), strict=True))
    faces = np.concatenate([np.zeros((0, 3), np.int32), *mesh.faces()])
    with parsing(path, "mesh", "export it again"):
        return MeshArrays(points, faces, colors, labels)


def normal_sums(points: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return (V, 3) sums of the normals of the faces around, each twice as long as the face is large."""
    corners, total = points[faces], np.zeros_like(points)
    of_face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(total, faces[:, k], of_face)
    return total
