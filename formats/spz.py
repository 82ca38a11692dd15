"""SPZ, Niantic's compressed splat file: 20 bytes a Gaussian before gzip."""

from __future__ import annotations

import gzip
import io
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import write_bytes
from formats.errors import InputError
from formats.gaussians import GaussianCloud, unit_quaternions
from formats.reading import parsing, require_file

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_WRITTEN_VERSION = 2
_REST_BYTES = {0: 0, 1: 9, 2: 24, 3: 45}
_LEAST_BYTES = 19
_MOST_FRACTION_BITS = 24
_LEAST_LIMIT, _HIGHEST_RATIO = 32 << 20, 30
"""Bytes that any file may unpack to, and how often its own size: real maps pack to a half, bombs to a thousandth."""
_COLOR_SCALE = 0.15
_SH_C0 = 0.28209479177387814
# SPZ keeps x right, y up, z back; splat PLYs and this program x right, y down, z forward.
_FLIP = np.array([1, -1, -1], dtype=np.float32)


def write_spz(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud as SPZ version 2 without view-dependent colour; classes are not kept.

    Positions are fixed point of 24 bits with as many fraction bits as the scene's extent leaves (at most 16), scales
    steps of 1/16 in the logarithm, opacity, colour and rotation 8 bits. The same cloud gives the same bytes. Raises
    ValueError where a position is not finite or beyond 4 million, InputError when the disk refuses.
    """
    extent = float(np.abs(cloud.means).max(initial=0))
    if not np.isfinite(cloud.means).all() or extent >= 2**22:
        raise ValueError(f"write_spz: positions must be finite and below 4 million, got {extent:g}")
    fraction_bits = max(0, min(16, 21 - int(np.floor(np.log2(max(extent, 1e-9))))))
    header = _HEADER.pack(_MAGIC, _WRITTEN_VERSION, len(cloud), 0, fraction_bits, 0, 0)
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    dc = (cloud.colors - 0.5) / _SH_C0
    quat_xyzw = cloud.quat_wxyz[:, [1, 2, 3, 0]] * np.append(_FLIP, 1)
    quat_xyzw = quat_xyzw * np.where(quat_xyzw[:, 3:] < 0, -1, 1)
    parts = [
        _fixed24(cloud.means * _FLIP, fraction_bits),
        _byte(opacity * 255),
        _byte(dc * (_COLOR_SCALE * 255) + 0.5 * 255),
        _byte((cloud.log_scales + 10) * 16),
        _byte(quat_xyzw[:, :3] * 127.5 + 127.5),
    ]
    buffer = io.BytesIO()
    # mtime 0: the clock must not get into the file
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0) as file:
        file.write(header + b"".join(part.tobytes() for part in parts))
    write_bytes(path, buffer.getvalue())


def read_spz(path: Path) -> GaussianCloud:
    """The Gaussians of an SPZ file of version 2 or 3; view-dependent colour is dropped.

    Raises InputError for another version, for a damaged file, and for one that would unpack to far more than it is.
    """
    size = require_file(path)
    with parsing(path, "SPZ file"), gzip.open(path, "rb") as file:
        return _read_stream(file, path, max(_LEAST_LIMIT, size * _HIGHEST_RATIO))


def _read_stream(file: gzip.GzipFile, path: Path, most: int) -> GaussianCloud:
    magic, version, count, degree, fraction_bits, _, _ = _HEADER.unpack(file.read(_HEADER.size))
    if magic != _MAGIC or version not in (2, 3) or degree not in _REST_BYTES:
        raise InputError(f"{path} is no SPZ file of version 2 or 3: export it with another program's default settings")
    if count * _LEAST_BYTES > most or fraction_bits > _MOST_FRACTION_BITS:
        raise InputError(f"{path} promises {count} Gaussians, more than it can hold: it is damaged")
    positions = _fields(file, count, 9)
    opacity = _fields(file, count, 1)[:, 0] / 255.0
    colors = (_fields(file, count, 3) / 255.0 - 0.5) / _COLOR_SCALE
    log_scales = _fields(file, count, 3) / 16.0 - 10
    rotations = _fields(file, count, 3 if version == 2 else 4)
    quat_xyzw = _first_three(rotations) if version == 2 else _smallest_three(rotations)
    inside = opacity.clip(1e-4, 1 - 1e-4)
    return GaussianCloud(
        means=_from_fixed24(positions, fraction_bits) * _FLIP,
        log_scales=log_scales.astype(np.float32),
        quat_wxyz=unit_quaternions((quat_xyzw * np.append(_FLIP, 1))[:, [3, 0, 1, 2]]),
        opacity_logits=np.log(inside / (1 - inside)).astype(np.float32),
        colors=(colors * _SH_C0 + 0.5).astype(np.float32),
        dropped_sh_degree=degree,
    )


def _fields(file: gzip.GzipFile, count: int, width: int) -> NDArray[np.uint8]:
    data = file.read(count * width)
    if len(data) != count * width:
        raise EOFError("it ends before its Gaussians do")
    return np.frombuffer(data, dtype=np.uint8).reshape(count, width)


def _byte(values: NDArray) -> NDArray[np.uint8]:
    return np.floor(values + 0.5).clip(0, 255).astype(np.uint8)


def _fixed24(values: NDArray[np.float32], fraction_bits: int) -> NDArray[np.uint8]:
    """(M, 9) bytes: three little-endian 24 bit two's complement numbers."""
    fixed = np.floor(values.astype(np.float64) * 2**fraction_bits + 0.5).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(len(values), 3, 4)[:, :, :3].copy()


def _from_fixed24(data: NDArray[np.uint8], fraction_bits: int) -> NDArray[np.float32]:
    wide = np.zeros((len(data), 3, 4), dtype=np.uint8)
    wide[:, :, 1:] = data.reshape(-1, 3, 3)  # in the upper bytes, so that the shift brings the sign along
    return ((wide.view("<i4")[:, :, 0] >> 8) / 2.0**fraction_bits).astype(np.float32)


def _first_three(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(M, 4) x y z w of version 2: x, y, z in a byte each, w >= 0 from the length."""
    xyz = data / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1, keepdims=True)))
    return np.concatenate([xyz, w], axis=1)


def _smallest_three(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(M, 4) x y z w of version 3: the largest component's index in 2 bits, the others in 10 bits each, sign first."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    largest = packed >> 30
    quat = np.zeros((len(data), 4))
    for i in (3, 2, 1, 0):
        here = largest != i
        magnitude = (packed & 511) / 511 * np.sqrt(0.5)
        quat[here, i] = np.where(packed >> 9 & 1, -magnitude, magnitude)[here]
        packed = np.where(here, packed >> 10, packed)
    rest = np.sqrt(np.maximum(0, 1 - (quat**2).sum(axis=1)))
    quat[np.arange(len(data)), largest] = rest
    return quat
