"""SPZ, Niantic's compressed splat file: 19 or 20 bytes a Gaussian before compression.

Version 4 is a plain header, a table and a Zstandard stream for each attribute. Version 2, which glTF's extension takes,
is one gzip stream, and keeps rotations in three bytes instead of four. Layout by the README of
github.com/nianticlabs/spz.
"""

import gzip
import io
import struct
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from .atomic import write_bytes
from .gaussians import GaussianCloud
from .ply import SH_C0

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_COLOR_SCALE = 0.15
# SPZ keeps x right, y up, z back; splat PLYs and this program x right, y down, z forward.
_FLIP = np.array([1, -1, -1], dtype=np.float32)


def write_spz(path: Path, cloud: GaussianCloud) -> None:
    """Write `spz_bytes` of version 4 to a file. Raises what that raises, and InputError when the disk refuses."""
    write_bytes(path, spz_bytes(cloud, 4))


def spz_bytes(cloud: GaussianCloud, version: int) -> bytes:
    """Encode a cloud as SPZ version 4 or 2, without view-dependent colour; classes are not kept.

    Positions are fixed point of 24 bits with as many fraction bits as the scene's extent leaves (at most 16), scales
    steps of 1/16 in the logarithm, opacity and colour 8 bits, rotations 10 bits a component (8 in version 2). The same
    cloud gives the same bytes. Raises ValueError where a position is not finite or beyond 4 million.
    """
    extent = float(np.abs(cloud.means).max(initial=0))
    if not np.isfinite(cloud.means).all() or extent >= 2**22:
        raise ValueError(f"spz_bytes: positions must be finite and below 4 million, got {extent:g}")
    fraction_bits = max(0, min(16, 21 - int(np.floor(np.log2(max(extent, 1e-9))))))
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    streams = [
        _fixed24(cloud.means * _FLIP, fraction_bits).tobytes(),
        _byte(opacity * 255).tobytes(),
        _byte((cloud.colors - 0.5) / SH_C0 * (_COLOR_SCALE * 255) + 0.5 * 255).tobytes(),
        _byte((cloud.log_scales + 10) * 16).tobytes(),
        _packed_rotations(cloud.quat_wxyz[:, [1, 2, 3, 0]] * np.append(_FLIP, 1), version).tobytes(),
    ]
    return (_container_4 if version == 4 else _container_2)(streams, len(cloud), fraction_bits)


def _container_4(streams: list[bytes], count: int, fraction_bits: int) -> bytes:
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in streams]
    header = _HEADER_4.pack(_MAGIC, 4, count, 0, fraction_bits, 0, len(streams), _HEADER_4.size)
    table = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([header, *table, *packed])


def _container_2(streams: list[bytes], count: int, fraction_bits: int) -> bytes:
    buffer = io.BytesIO()
    # mtime 0: the clock must not get into the file
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0) as file:
        file.write(_HEADER.pack(_MAGIC, 2, count, 0, fraction_bits, 0, 0) + b"".join(streams))
    return buffer.getvalue()


def _byte(values: NDArray) -> NDArray[np.uint8]:
    return np.floor(values + 0.5).clip(0, 255).astype(np.uint8)


def _fixed24(values: NDArray[np.float32], fraction_bits: int) -> NDArray[np.uint8]:
    """(M, 9) bytes: three little-endian 24 bit two's complement numbers."""
    fixed = np.floor(values.astype(np.float64) * 2**fraction_bits + 0.5).astype("<i4")
    return np.ascontiguousarray(fixed).view(np.uint8).reshape(len(values), 3, 4)[:, :, :3].copy()


def _packed_rotations(quat_xyzw: NDArray, version: int) -> NDArray[np.uint8] | NDArray[np.uint32]:
    """Of (M, 4) x y z w, in version 2 (M, 3): x, y and z in a byte each, w made positive; else (M,): the number of the
    largest component, which is made positive and left out, in 2 bits, the others in 10 bits each, sign first."""
    if version == 2:
        return _byte((quat_xyzw[:, :3] * np.where(quat_xyzw[:, 3:] < 0, -1, 1) + 1) * 127.5)
    largest = np.abs(quat_xyzw).argmax(axis=1)
    sign = np.where(np.take_along_axis(quat_xyzw, largest[:, None], 1) < 0, -1, 1)
    quat = quat_xyzw * sign / np.maximum(np.linalg.norm(quat_xyzw, axis=1, keepdims=True), 1e-12)
    packed = largest.astype(np.uint32)
    for i in range(4):
        magnitude = np.round(np.abs(quat[:, i]) / np.sqrt(0.5) * 511).clip(0, 511).astype(np.uint32)
        bits = magnitude | np.where(quat[:, i] < 0, np.uint32(512), np.uint32(0))
        packed = np.where(largest == i, packed, packed << np.uint32(10) | bits).astype("<u4")
    return packed
