"""Looking into an ONNX file before anything runs it: where it keeps its weights."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path

from ...formats.errors import InputError
from ...formats.reading import opened, parsing

# Field numbers of onnx.proto: which fields lead to tensors, by message.
_DESCEND = {
    "model": {7: "graph", 25: "function"},
    "function": {7: "node"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "tensor": {13: "entry"},
}
_MAX_DEPTH = 32


def require_own_weights(path: Path) -> None:
    """Raise InputError unless `path` is an ONNX file all of whose external weights are in its own folder."""
    folder = path.parent.resolve()
    for location in external_locations(path):
        target = folder / location
        if "\0" in location or Path(location).is_absolute() or not target.resolve().is_relative_to(folder):
            raise InputError(
                f"{path}: keeps weights in {location!r}, outside its own folder. Such a file may read anything on "
                "this disk; get the network from its makers again"
            )
        if not target.is_file():
            raise InputError(f"{path}: its weights {location} are not beside it. Download that file as well")


def external_locations(path: Path) -> list[str]:
    """Names of the files with weights outside the ONNX file, sorted. Raises InputError when it is no ONNX file."""
    with (
        opened(path) as stream,
        parsing(path, "ONNX network", "download it again"),
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        return sorted(set(_locations(data, 0, len(data), "model", 0)))


def _locations(data: mmap.mmap, start: int, end: int, message: str, depth: int) -> Iterator[str]:
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deep")
    for field, first, last in _fields(data, start, end):
        inner = _DESCEND[message].get(field)
        if inner == "entry":
            texts = {f: data[a:b] for f, a, b in _fields(data, first, last)}
            if texts.get(1) == b"location":
                yield texts.get(2, b"").decode()
        elif inner is not None:
            yield from _locations(data, first, last, inner, depth + 1)


def _fields(data: mmap.mmap, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(number, first, last) of every length-delimited field of a protobuf message; the others are skipped."""
    at = start
    while at < end:
        tag, at = _varint(data, at, end)
        kind = tag & 7
        if kind == 2:
            length, at = _varint(data, at, end)
            if at + length > end:
                raise ValueError("field runs over its message")
            yield tag >> 3, at, at + length
            at += length
        elif kind == 0:
            _, at = _varint(data, at, end)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise ValueError("unknown wire type")
    if at != end:
        raise ValueError("message ends inside a field")


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            break
        byte = data[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError("number without an end")
