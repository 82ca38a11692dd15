"""PLY files: tables written in blocks and read again, clouds of points, and Gaussians as the original 3D Gaussian
splatting stores them (Kerbl et al. 2023)."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import InputError
from .gaussians import GaussianCloud
from .reading import opened

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * f_dc."""

_REST_COUNTS = {0: 0, 1: 9, 2: 24, 3: 45}
_MEANS, _NORMALS, _DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES, _ROTATION = ["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]
_PROB = "class_prob_"

_VERTEX = np.dtype([
    *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((name, "u1") for name in ("red", "green", "blue"))
])  # fmt: skip

_MAX_HEADER_BYTES = 1 << 20
_ROWS = 1 << 18
"""That are written at once."""
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"} | {
    "f4": "float",
    "f8": "double",
}


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


def read_ply_rows(path: Path, elements: dict[str, np.dtype]) -> dict[str, Rows]:
    """Open the elements of a PLY by `write_ply`; blocks are read lazily.

    `elements`: all of them in their order, a list as its length and its values. Raises InputError for a file that is
    missing or has others.
    """
    with opened(path) as file:
        head = file.read(_MAX_HEADER_BYTES)
    end = head.find(b"\nend_header\n") + len(b"\nend_header\n")
    counts = {m[1].decode(): int(m[2]) for m in re.finditer(rb"^element (\w+) (\d+)$", head[:end], re.MULTILINE)}
    rows = {}
    for name, dtype in elements.items():
        rows[name] = Rows(dtype, counts.get(name, 0), _Blocks(path, dtype, counts.get(name, 0), end))
        end += dtype.itemsize * rows[name].count
    if list(counts) != list(elements) or end != Path(path).stat().st_size:
        raise InputError(f"{path} is not as this program writes it: export it again")
    return rows


@dataclass(frozen=True)
class _Blocks:
    path: Path
    dtype: np.dtype
    count: int
    start: int

    def __iter__(self) -> Iterator[NDArray[Any]]:
        with opened(self.path) as file:
            file.seek(self.start)
            for rows in slices(self.count):
                yield np.fromfile(file, self.dtype, rows.stop - rows.start)


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
    write_ply(path, {"vertex": Rows(_VERTEX, len(points), _blocks(points, colors))}, [])


def _blocks(points: NDArray[np.float64], colors: NDArray[np.uint8]) -> Iterator[NDArray[Any]]:
    for rows in slices(len(points)):
        block = np.zeros(len(points[rows]), _VERTEX)
        for i, (axis, color) in enumerate((("x", "red"), ("y", "green"), ("z", "blue"))):
            block[axis], block[color] = points[rows, i], colors[rows, i]
        yield block


def write_gaussian_ply(
    path: Path, cloud: GaussianCloud | Sequence[GaussianCloud], class_names: tuple[str, ...] = (), *, sh_degree: int = 0
) -> None:
    """Write a cloud, or the parts of one, so that splat viewers and trainers take it as their own.

    The properties are those of the original code in its order: x y z, nx ny nz (0), f_dc_0..2, f_rest_* (as many as
    `sh_degree` has, all 0), opacity (logit), scale_0..2 (log), rot_0..3 (w x y z); after them class_id (uchar) and
    class_prob_<number> (float) where the cloud has classes, of those that are anywhere above 0: tables of 100 classes
    would otherwise fill most of the file with zeros. Degree 0, the default, is what the original writes when it
    trains without view-dependent colour; 3 is for readers that insist on 45 of them. Class names go to comments.

    Raises ValueError for another degree or a value that is not finite, InputError when the disk refuses.
    """
    if sh_degree not in _REST_COUNTS:
        raise ValueError(f"write_gaussian_ply: sh_degree must be 0 to 3, got {sh_degree}")
    fields = [*_MEANS, *_NORMALS, *_DC, *(f"f_rest_{i}" for i in range(_REST_COUNTS[sh_degree]))]
    fields += ["opacity", *_SCALES, *_ROTATION]
    dtype: list[tuple[str, str]] = [(name, "<f4") for name in fields]
    parts, count, found = [cloud] if isinstance(cloud, GaussianCloud) else cloud, 0, set[int]()
    for part in parts:
        count += len(part)
        if part.class_probs is not None:
            found |= {i for i, of in enumerate(part.class_probs.T) if of.any()}
    if parts[0].class_ids is not None:
        dtype.append(("class_id", "u1"))
    occurring = sorted(found)
    dtype += [(f"{_PROB}{i}", "<f4") for i in occurring]
    blocks = (_rows(part, rows, np.dtype(dtype), occurring) for part in parts for rows in slices(len(part)))
    comments = [f"class {i} {name}" for i, name in enumerate(class_names)]
    write_ply(path, {"vertex": Rows(np.dtype(dtype), count, blocks)}, comments)


def _rows(cloud: GaussianCloud, rows: slice, dtype: np.dtype, occurring: list[int]) -> NDArray[Any]:
    vertex = np.zeros(rows.stop - rows.start, dtype=dtype)
    _fill(vertex, _MEANS, cloud.means[rows])
    _fill(vertex, _DC, (cloud.colors[rows] - np.float32(0.5)) / np.float32(SH_C0))
    _fill(vertex, ["opacity"], cloud.opacity_logits[rows, None])
    _fill(vertex, _SCALES, cloud.log_scales[rows])
    _fill(vertex, _ROTATION, cloud.quat_wxyz[rows])
    if cloud.class_ids is not None:
        vertex["class_id"] = cloud.class_ids[rows]
    if cloud.class_probs is not None:
        _fill(vertex, [f"{_PROB}{i}" for i in occurring], cloud.class_probs[rows][:, occurring])
    return vertex


def _fill(vertex: NDArray[Any], names: list[str], values: NDArray[np.float32]) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"write_gaussian_ply: {names[0]} holds a value that is not finite")
    for i, name in enumerate(names):
        vertex[name] = values[:, i]
