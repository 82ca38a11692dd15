"""PLY files: tables of vertices read with limits and written in blocks, clouds of points, and Gaussian splats in the
layout of the original 3D Gaussian splatting (Kerbl et al. 2023)."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import InputError
from .gaussians import GaussianCloud, parts_of, unit_quaternions
from .reading import opened, parsing

if TYPE_CHECKING:
    from plyfile import PlyData  # under the GPL: imported for PLY files of other programs only

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
_MIN_BYTES_PER_ASCII_VALUE = 2
_LARGEST = float(np.finfo(np.float32).max)
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"} | {
    "f4": "float",
    "f8": "double",
}


def read_ply(path: Path) -> "PlyData":
    """Read a PLY file by plyfile. Raises InputError when it is missing, a git-LFS pointer, no PLY, or cut short."""
    with opened(path) as file:
        head = file.read(_MAX_HEADER_BYTES)
    if not head.startswith(b"ply"):
        raise InputError(f"{path} is no PLY file (it does not begin with 'ply'): check that it is the right file")
    _require_whole(path, head)
    with parsing(path, "PLY file"):
        return _parsed(path)


def _parsed(path: Path) -> "PlyData":
    """By mapping where all rows have the same length: plyfile's other way takes 20 s for half a million rows."""
    from plyfile import PlyData, PlyElementParseError

    try:
        return PlyData.read(str(path), mmap="c", known_list_len={"face": {"vertex_indices": 3, "vertex_index": 3}})
    except PlyElementParseError:
        return PlyData.read(str(path), mmap=False)  # not all faces are triangles


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


def read_rows(path: Path, elements: dict[str, np.dtype]) -> dict[str, Rows]:
    """Read the elements of a PLY by `write_ply`, of which nothing is read before their blocks are.

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


def columns(vertex: NDArray[Any], names: list[str], path: Path) -> NDArray[np.float32]:
    """Return (rows, names) float32 of these properties, infinity as the largest number there is.

    Raises InputError naming those that are missing or hold NaN.
    """
    present = vertex.dtype.names or ()
    missing = [name for name in names if name not in present]
    if missing:
        raise InputError(f"{path} lacks the properties {', '.join(missing)}: it is another kind of PLY")
    with parsing(path, "PLY of numbers"):
        values = np.stack([np.clip(vertex[name], -_LARGEST, _LARGEST).astype(np.float32) for name in names], axis=1)
    if np.isnan(values).any():
        raise InputError(f"{path}: {', '.join(names)} hold values that are no numbers: export it again")
    return values


def _require_whole(path: Path, head: bytes) -> None:
    """Compare the counts in the header with the size of the file, before anyone allocates for them."""
    found = re.search(rb"[\r\n]end_header", head)
    end = found.start() + 1 if found else -1
    if end < 0:
        raise InputError(f"{path} has no PLY header end: it is damaged, copy or export it again")
    available = Path(path).stat().st_size - end
    is_ascii = b"format ascii" in head[:end]
    counts, row_bytes = [0], [0]
    for line in head[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == "element":
            counts.append(int(words[2]) if words[2].isdecimal() and len(words[2]) < 16 else 1 << 60)
            row_bytes.append(0)
        elif len(words) >= 3 and words[0] == "property":
            smallest = 1 if words[1] == "list" else _SIZES.get(words[1], 1)
            row_bytes[-1] += _MIN_BYTES_PER_ASCII_VALUE if is_ascii else smallest
    # Rows without properties take no space, and have no sense either.
    needed = sum(count * max(size, 1) for count, size in zip(counts, row_bytes, strict=True))
    if needed > available:
        raise InputError(
            f"{path} declares {needed / 1e6:.1f} MB of data and contains {available / 1e6:.1f}: "
            "it was not copied completely, copy or export it again"
        )


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
    parts, count, found = parts_of(cloud), 0, set[int]()
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


def read_gaussian_ply(path: Path) -> GaussianCloud:
    """Read the Gaussians of a PLY by this or another program, of any spherical-harmonic degree.

    Raises InputError when the file is missing, damaged, a git-LFS pointer, or a PLY of another kind.
    """
    path = Path(path)
    ply = read_ply(path)
    if "vertex" not in ply:
        raise InputError(f"{path} has no vertices: it is no Gaussian splat PLY")
    vertex = ply["vertex"].data
    names = vertex.dtype.names or ()
    if "packed_position" in names:
        raise InputError(
            f"{path} is a compressed PLY of SuperSplat (PlayCanvas), which is not supported: export it there again as "
            "an uncompressed PLY, or as .spz or .splat"
        )
    if not set(_SCALES[:1] + _DC) <= set(names):
        kind = "a mesh" if "face" in ply else "a point cloud"
        raise InputError(f"{path} is {kind}, not a Gaussian splat PLY: it lacks f_dc_0..2 and scale_0..2")
    with parsing(path, "Gaussian splat PLY"):
        return _cloud(ply, path)


def _cloud(ply: "PlyData", path: Path) -> GaussianCloud:
    vertex = ply["vertex"].data
    names = vertex.dtype.names or ()
    return GaussianCloud(
        means=columns(vertex, _MEANS, path),
        log_scales=_log_scales(vertex, path),
        quat_wxyz=unit_quaternions(columns(vertex, _ROTATION, path)),
        opacity_logits=columns(vertex, ["opacity"], path)[:, 0],
        colors=columns(vertex, _DC, path) * np.float32(SH_C0) + np.float32(0.5),
        class_ids=vertex["class_id"].astype(np.uint8) if "class_id" in names else None,
        class_probs=_class_probs(vertex, ply.comments, path),
    )


def _fill(vertex: NDArray[Any], names: list[str], values: NDArray[np.float32]) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"write_gaussian_ply: {names[0]} holds a value that is not finite")
    for i, name in enumerate(names):
        vertex[name] = values[:, i]


def _log_scales(vertex: NDArray[Any], path: Path) -> NDArray[np.float32]:
    """Flat splats (2D Gaussian splatting) have two scales only: the third is made thin."""
    names = [name for name in _SCALES if name in (vertex.dtype.names or ())]
    scales = columns(vertex, names if len(names) == 2 else _SCALES, path)
    thin = (
        scales.min(axis=1, keepdims=True, initial=0) - np.float32(math.log(100)) if len(names) == 2 else scales[:, :0]
    )
    return np.concatenate([scales, thin], axis=1)


def _class_probs(vertex: NDArray[Any], comments: list[str], path: Path) -> NDArray[np.float32] | None:
    """(M, C) for as many classes as the comments name, or as are there; those without a property are 0."""
    names = [n for n in vertex.dtype.names or () if n.startswith(_PROB) and n[len(_PROB) :].isdecimal()]
    if not names:
        return None
    classes = [int(n[len(_PROB) :]) for n in names]
    named = [int(found[1]) for c in comments if (found := re.match(r"class (\d+) ", c + " "))]
    count = max(*classes, *named, 0) + 1
    if count > 255:
        raise InputError(f"{path} has a class {count - 1}: class numbers end at 254")
    out = np.zeros((len(vertex), count), np.float32)
    out[:, classes] = columns(vertex, names, path)
    return out
