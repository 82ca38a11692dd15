"""Readers of the splat files that the program writes, by the formats' descriptions: for round trips."""

import gzip
import io
import json
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import zstandard
from numpy.typing import NDArray

from msgs_slam.formats.glb import LABEL
from msgs_slam.formats.splats import COMPRESSION, EXTENSION, SH_C0, GaussianCloud

FLIP = np.array([1, -1, -1], np.float32)


def read_gaussian_ply(path: Path) -> GaussianCloud:
    """By plyfile; class probabilities of classes without a property are 0."""
    ply = plyfile.PlyData.read(str(path))
    vertex, names = ply["vertex"].data, [p.name for p in ply["vertex"].properties]

    def columns(*wanted: str) -> NDArray[np.float32]:
        return np.stack([vertex[name].astype(np.float32) for name in wanted], axis=1)

    given = [name for name in names if name.startswith("class_prob_")]
    probs = None
    if given:
        classes = [int(name.removeprefix("class_prob_")) for name in given]
        probs = np.zeros((len(vertex), max(*classes, len(ply.comments) - 1) + 1), np.float32)
        probs[:, classes] = columns(*given)
    return GaussianCloud(
        columns("x", "y", "z"), columns(*(f"scale_{k}" for k in range(3))), columns(*(f"rot_{k}" for k in range(4))),
        columns("opacity")[:, 0], columns(*(f"f_dc_{k}" for k in range(3))) * np.float32(SH_C0) + np.float32(0.5),
        vertex["class_id"].astype(np.uint8) if "class_id" in names else None, probs,
    )  # fmt: skip


def read_gaussian_glb(path: Path) -> GaussianCloud:
    """By KHR_gaussian_splatting, or its compression by SPZ."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    primitive = document["meshes"][0]["primitives"][0]
    if packed := primitive["extensions"][EXTENSION].get("extensions", {}).get(COMPRESSION):
        view = document["bufferViews"][packed["bufferView"]]
        return unpack_spz(binary[view.get("byteOffset", 0) :][: view["byteLength"]])
    arrays = {name: _accessor(document, binary, i) for name, i in primitive["attributes"].items()}
    quat_xyzw = arrays[f"{EXTENSION}:ROTATION"] * np.append(FLIP, np.float32(1))
    return GaussianCloud(
        arrays["POSITION"] * FLIP, np.log(arrays[f"{EXTENSION}:SCALE"]), quat_xyzw[:, [3, 0, 1, 2]],
        _logits(arrays[f"{EXTENSION}:OPACITY"][:, 0]),
        arrays[f"{EXTENSION}:SH_DEGREE_0_COEF_0"] * np.float32(SH_C0) + np.float32(0.5),
        arrays[LABEL][:, 0].astype(np.uint8) if LABEL in arrays else None,
    )  # fmt: skip


def _accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float32]:
    accessor = document["accessors"][index]
    view, width = document["bufferViews"][accessor["bufferView"]], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    return np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def read_spz(path: Path) -> GaussianCloud:
    """A file of version 2, 3 or 4."""
    return unpack_spz(path.read_bytes())


def unpack_spz(data: bytes) -> GaussianCloud:
    """See `read_spz`."""
    if is_packed := data[:2] == b"\x1f\x8b":
        data = gzip.decompress(data)
    magic, version, count, _, fraction_bits, _, streams = struct.unpack_from("<4sIIBBBB", data)
    assert magic == b"NGSP"
    assert version in ((2, 3) if is_packed else (4,))
    widths = (9, 1, 3, 3, 3 if version == 2 else 4)
    if is_packed:
        ends = 16 + np.cumsum([0, *(count * width for width in widths)])
        parts = [data[a:b] for a, b in pairwise(ends)]
    else:
        table = struct.unpack_from("<I", data, 16)[0]
        sizes = [struct.unpack_from("<QQ", data, table + 16 * k)[0] for k in range(streams)]
        file = io.BytesIO(data[table + 16 * streams :])
        parts = [zstandard.ZstdDecompressor().decompress(file.read(size)) for size in sizes]
    places, opacities, colors, scales, turns = (
        np.frombuffer(part, np.uint8).reshape(count, width) for part, width in zip(parts, widths, strict=True)
    )
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[:, :, 1:] = places.reshape(-1, 3, 3)  # in the upper bytes, so that the shift brings the sign along
    quat_xyzw = (_first_three(turns) if version == 2 else _smallest_three(turns)) * np.append(FLIP, 1)
    return GaussianCloud(
        ((wide.view("<i4")[:, :, 0] >> 8) / 2.0**fraction_bits).astype(np.float32) * FLIP,
        (scales / 16.0 - 10).astype(np.float32), quat_xyzw[:, [3, 0, 1, 2]].astype(np.float32),
        _logits(opacities[:, 0] / 255.0),
        ((colors / 255.0 - 0.5) / 0.15 * SH_C0 + 0.5).astype(np.float32),
    )  # fmt: skip


def _logits(opacity: NDArray) -> NDArray[np.float32]:
    inside = opacity.astype(np.float64).clip(1e-4, 1 - 1e-4)
    return np.log(inside / (1 - inside)).astype(np.float32)


def _first_three(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(M, 4) x y z w: x, y, z in a byte each, w >= 0 from the length."""
    xyz = data / 127.5 - 1
    return np.concatenate([xyz, np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1, keepdims=True)))], axis=1)


def _smallest_three(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(M, 4) x y z w: the largest component's index in 2 bits, the others in 10 bits each, sign first."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    largest, quat = packed >> 30, np.zeros((len(data), 4))
    for i in (3, 2, 1, 0):
        here = largest != i
        magnitude = (packed & 511) / 511 * np.sqrt(0.5)
        quat[here, i] = np.where(packed >> 9 & 1, -magnitude, magnitude)[here]
        packed = np.where(here, packed >> 10, packed)
    quat[np.arange(len(data)), largest] = np.sqrt(np.maximum(0, 1 - (quat**2).sum(axis=1)))
    return quat
