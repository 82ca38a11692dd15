"""The vertex table of a PLY file, read with limits."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElementParseError

from .atomic import atomic_path
from .errors import InputError
from .reading import opened, parsing

_MAX_HEADER_BYTES = 1 << 20
_ROWS = 1 << 18
"""That are written at once."""
_MIN_BYTES_PER_ASCII_VALUE = 2
_LARGEST = float(np.finfo(np.float32).max)


def read_ply(path: Path) -> PlyData:
    """A PLY file by plyfile. Raises InputError when it is missing, a git-LFS pointer, no PLY, or cut short."""
    with opened(path) as file:
        head = file.read(_MAX_HEADER_BYTES)
    if not head.startswith(b"ply"):
        raise InputError(f"{path} is no PLY file (it does not begin with 'ply'): check that it is the right file")
    _require_whole(path, head)
    with parsing(path, "PLY file"):
        return _parsed(path)


def _parsed(path: Path) -> PlyData:
    """By mapping where all rows have the same length: plyfile's other way takes 20 s for half a million rows."""
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
        file.write("\n".join([*header, "end_header\n"]).encode("ascii", errors="replace"))
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
    """The elements of a PLY by `write_ply`, of which nothing is read before their blocks are.

    `elements`: all of them in their order, a list as its length and its values. Raises InputError for a file that is
    missing or has others.
    """
    with opened(path) as file:
        head = file.read(_MAX_HEADER_BYTES)
    end = head.find(b"end_header\n") + len(b"end_header\n")
    counts = {m[1].decode(): int(m[2]) for m in re.finditer(rb"element (\w+) (\d+)\n", head[:end])}
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
    """(rows, names) float32 of these properties, infinity as the largest number there is.

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
    end = head.find(b"end_header")
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
