"""SPZ, Niantic's compressed splat file: 19 or 20 bytes a Gaussian before compression.

Version 4 is a plain header, a table and a Zstandard stream for each attribute; versions 2 and 3 are one gzip stream.
Layout by the README of github.com/nianticlabs/spz; version 2 keeps rotations in three bytes, the others in four.
"""

import gzip
import io
import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from numpy.typing import NDArray

from .atomic import write_bytes
from .errors import InputError
from .gaussians import GaussianCloud, unit_quaternions
from .ply import SH_C0
from .reading import opened, parsing, require_file

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_MAX_STREAMS = 16
_MAX_DEGREE = 4
_MIN_BYTES = 19
_MAX_FRACTION_BITS = 24
_MIN_LIMIT, _MAX_RATIO = 32 << 20, 30
"""Bytes that any file may unpack to, and how often its own size: real maps pack to a half, bombs to a thousandth."""
_COLOR_SCALE = 0.15
# SPZ keeps x right, y up, z back; splat PLYs and this program x right, y down, z forward.
_FLIP = np.array([1, -1, -1], dtype=np.float32)


def write_spz(path: Path, cloud: GaussianCloud, version: int = 4) -> None:
    """Write `spz_bytes` to a file. Raises what that raises, and InputError when the disk refuses."""
    write_bytes(path, spz_bytes(cloud, version))


def spz_bytes(cloud: GaussianCloud, version: int) -> bytes:
    """Encode a cloud as SPZ version 4 (or 3 or 2, for older readers) without view-dependent colour; classes are not
    kept.

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
    if version == 4:
        return _container_4(streams, len(cloud), fraction_bits)
    return _container_3(streams, len(cloud), fraction_bits, version)


def _container_4(streams: list[bytes], count: int, fraction_bits: int) -> bytes:
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in streams]
    header = _HEADER_4.pack(_MAGIC, 4, count, 0, fraction_bits, 0, len(streams), _HEADER_4.size)
    table = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([header, *table, *packed])


def _container_3(streams: list[bytes], count: int, fraction_bits: int, version: int) -> bytes:
    buffer = io.BytesIO()
    # mtime 0: the clock must not get into the file
    with gzip.GzipFile(fileobj=buffer, mode="wb", mtime=0) as file:
        file.write(_HEADER.pack(_MAGIC, version, count, 0, fraction_bits, 0, 0) + b"".join(streams))
    return buffer.getvalue()


def read_spz(path: Path) -> GaussianCloud:
    """Read the Gaussians of an SPZ file of version 2, 3 or 4; view-dependent colour is dropped.

    Raises InputError for another version, for a damaged file, and for one that would unpack to far more than it is.
    """
    size = require_file(path)
    with opened(path) as plain, parsing(path, "SPZ file"):
        return read_spz_stream(plain, size, path)


def read_spz_stream(plain: BinaryIO, size: int, path: Path) -> GaussianCloud:
    """Read as `read_spz` does `size` bytes that lie open; `path` is for messages. Damage raises whatever comes of it
    too."""
    limit = max(_MIN_LIMIT, size * _MAX_RATIO)
    is_plain = plain.read(4) == _MAGIC
    plain.seek(0)
    if is_plain:
        return _read_version_4(plain, path, limit)
    with gzip.open(plain, "rb") as file:
        magic, version, count, degree, fraction_bits, _, _ = _HEADER.unpack(file.read(_HEADER.size))
        _require_sane(path, magic == _MAGIC and version in (2, 3), count, degree, fraction_bits, limit)
        streams = [_fields(file, count, width) for width in (9, 1, 3, 3, 3 if version == 2 else 4)]
    return _unpacked(streams, fraction_bits)


def _read_version_4(file: BinaryIO, path: Path, limit: int) -> GaussianCloud:
    _, version, count, degree, fraction_bits, _, number, table = _HEADER_4.unpack(file.read(_HEADER_4.size))
    _require_sane(path, version == 4 and 5 <= number <= _MAX_STREAMS, count, degree, fraction_bits, limit)
    file.seek(table)
    sizes = [struct.unpack("<QQ", file.read(16))[0] for _ in range(number)]
    streams = []
    for packed, width in zip(sizes, (9, 1, 3, 3, 4), strict=False):
        data = io.BytesIO(file.read(min(packed, limit)))
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            streams.append(_fields(stream, count, width))
    return _unpacked(streams, fraction_bits)


def _require_sane(path: Path, known: bool, count: int, degree: int, fraction_bits: int, limit: int) -> None:
    if not known or degree > _MAX_DEGREE:
        raise InputError(f"{path} is no SPZ file of version 2 to 4: export it with another program's default settings")
    if count * _MIN_BYTES > limit or fraction_bits > _MAX_FRACTION_BITS:
        raise InputError(f"{path} declares {count} Gaussians, more than it can contain: it is damaged")


def _unpacked(streams: list[NDArray[np.uint8]], fraction_bits: int) -> GaussianCloud:
    """Positions, opacities, colours, scales, rotations as bytes (M, 9), (M, 1), (M, 3), (M, 3), (M, 3 or 4)."""
    positions, opacities, colors, scales, rotations = streams
    quat_xyzw = _first_three(rotations) if rotations.shape[1] == 3 else _smallest_three(rotations)
    inside = (opacities[:, 0] / 255.0).clip(1e-4, 1 - 1e-4)
    return GaussianCloud(
        means=_from_fixed24(positions, fraction_bits) * _FLIP,
        log_scales=(scales / 16.0 - 10).astype(np.float32),
        quat_wxyz=unit_quaternions((quat_xyzw * np.append(_FLIP, 1))[:, [3, 0, 1, 2]]),
        opacity_logits=np.log(inside / (1 - inside)).astype(np.float32),
        colors=((colors / 255.0 - 0.5) / _COLOR_SCALE * SH_C0 + 0.5).astype(np.float32),
    )


def _fields(file: gzip.GzipFile | zstandard.ZstdDecompressionReader, count: int, width: int) -> NDArray[np.uint8]:
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


def _packed_rotations(quat_xyzw: NDArray, version: int) -> NDArray[np.uint8] | NDArray[np.uint32]:
    """(M,) of (M, 4), as `_smallest_three` reads them: the largest component is made positive and left out; of version
    2 (M, 3), as `_first_three` reads them."""
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
