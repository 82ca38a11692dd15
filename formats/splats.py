"""Gaussians as plain arrays, and the splat files that hold them.

- PLY as the original 3D Gaussian splatting writes it (Kerbl et al. 2023).
- GLB by KHR_gaussian_splatting (Khronos): a primitive of points whose attributes are POSITION and, prefixed with the
  extension's name, ROTATION (x y z w), SCALE (standard deviations), OPACITY (0..1) and SH_DEGREE_0_COEF_0. COLOR_0 is
  for programs that do not know the extension: they show a cloud of coloured points.
- GLB by KHR_gaussian_splatting_compression_spz_2 (Khronos, draft), all that CesiumJS draws: the attributes are an SPZ
  file of version 2 in a buffer view.
- SPZ, Niantic's (github.com/nianticlabs/spz): 19 or 20 bytes a Gaussian before compression. Version 4 is a plain
  header, a table and a Zstandard stream for each attribute; version 2 is one gzip stream.
- SOG version 2, PlayCanvas's (developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog): an archive of
  images in which a pixel is a Gaussian.

In splat PLYs, in SOG and here, x is right, y down and z forward; in SPZ and glTF y is up and z backward.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from PIL import Image

from .atomic import write_bytes
from .glb import LABEL, UNLIT, Part, glb_document, linear, material, write_glb, write_primitive
from .ply import Rows, slices, write_ply
from .trajectory import FARTHEST

Array = NDArray[np.float64]

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * f_dc."""
EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
_PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_LARGEST_LOG = 20.0
"""exp of it is half a `FARTHEST`: the squares that make a covariance still fit into float32."""
_FLIP = np.array([1, -1, -1], dtype=np.float32)

_PLY_FIELDS = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip

_SPZ_HEADER = struct.Struct("<4sIIBBBB")
_SPZ_HEADER_4 = struct.Struct("<4sIIBBBBI12x")
_SPZ_COLOR_SCALE = 0.15

_LEVELS = 256
_ROUNDS = 10
_FIRST_QUATERNION_KIND = 252
_MORTON_BITS = 10


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """M Gaussians with the raw parameters of the original 3D Gaussian splatting.

    means (M, 3); log_scales (M, 3) logarithms of the standard deviations along the own axes; quat_wxyz (M, 4) turning
    own axes into the world; opacity_logits (M,); colors (M, 3) RGB seen from everywhere, 0..1 for what a screen can
    show; all float32. class_ids (M,) uint8, class_probs (M, C) float32 and the numbers (M,) uint16 of their things, 0
    for none; None where the file has none. View-dependent colour is not kept.
    """

    means: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    quat_wxyz: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    colors: NDArray[np.float32]
    class_ids: NDArray[np.uint8] | None = None
    class_probs: NDArray[np.float32] | None = None
    things: NDArray[np.uint16] | None = None

    def __post_init__(self) -> None:
        m = len(self.means)
        shapes = {"means": (m, 3), "log_scales": (m, 3), "quat_wxyz": (m, 4), "opacity_logits": (m,), "colors": (m, 3)}
        classes = 0 if self.class_probs is None else self.class_probs.shape[-1]
        for name, shape in {**shapes, "class_ids": (m,), "class_probs": (m, classes), "things": (m,)}.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"GaussianCloud: {name}: got shape {array.shape}, expected {shape}")
            if array is not None and not np.isfinite(array).all():
                raise ValueError(f"GaussianCloud: {name} holds a value that is not finite")
        if m and not (self.log_scales.max() < _LARGEST_LOG and np.abs(self.means).max() < FARTHEST):
            raise ValueError("GaussianCloud: a Gaussian is too large or too far away to be drawn")

    def __len__(self) -> int:
        return len(self.means)

    def only(self, rows: NDArray) -> GaussianCloud:
        """Select Gaussians by a mask (M,) or by indices."""
        chosen: dict[str, Any] = {name: None if a is None else a[rows] for name, a in vars(self).items()}
        return GaussianCloud(**chosen)

    def opacities(self) -> Array:
        """Return (M,) from 0 to 1."""
        return np.asarray(1 / (1 + np.exp(-self.opacity_logits.astype(np.float64))))


def isotropic_cloud(
    means: NDArray[np.float32],
    log_radii: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    colors: NDArray[np.float32],
    class_probs: NDArray[np.float32] | None = None,
) -> GaussianCloud:
    """Return a cloud of balls: log_radii (M,) on all axes, no rotation, class ids from the largest probability."""
    if class_probs is not None and not 0 < class_probs.shape[1] <= 255:
        raise ValueError(f"isotropic_cloud: got {class_probs.shape[1]} classes, expected 1 to 255")
    scales, turns = np.repeat(log_radii[:, None], 3, axis=1), np.tile([1, 0, 0, 0], (len(means), 1))
    means, scales, turns, opacity_logits, colors = (
        array.astype(np.float32, copy=False) for array in (means, scales, turns, opacity_logits, colors)
    )
    if class_probs is None:
        return GaussianCloud(means, scales, turns, opacity_logits, colors)
    ids = class_probs.argmax(axis=1).astype(np.uint8)
    probs = class_probs.astype(np.float32, copy=False)
    return GaussianCloud(means, scales, turns, opacity_logits, colors, ids, probs)


# PLY --------------------------------------------------------------------------------------------------------------


def write_gaussian_ply(
    path: Path, cloud: GaussianCloud | Sequence[GaussianCloud], class_names: tuple[str, ...] = ()
) -> None:
    """Write a cloud, or the parts of one, so that splat viewers and trainers take it as their own.

    The properties are those of the original code in its order, as it writes them where it trains without view-dependent
    colour: x y z, nx ny nz (0), f_dc_0..2, opacity (logit), scale_0..2 (log), rot_0..3 (w x y z); after them class_id
    (uchar) and class_prob_<number> (float) where the cloud has classes, of those that are anywhere above 0: tables of
    100 classes would otherwise fill most of the file with zeros; and thing (ushort) where it has things. Class names go
    to comments.

    Raises ValueError for a value that is not finite, InputError when the disk refuses.
    """
    parts, count, found = [cloud] if isinstance(cloud, GaussianCloud) else cloud, 0, set[int]()
    for part in parts:
        count += len(part)
        if part.class_probs is not None:
            found |= {i for i, of in enumerate(part.class_probs.T) if of.any()}
    occurring = sorted(found)
    fields = [(name, "<f4") for name in _PLY_FIELDS]
    fields += [("class_id", "u1")] * (parts[0].class_ids is not None)
    fields += [(f"class_prob_{i}", "<f4") for i in occurring]
    dtype = np.dtype([*fields, *[("thing", "<u2")] * (parts[0].things is not None)])
    blocks = (_ply_rows(part, rows, dtype, occurring) for part in parts for rows in slices(len(part)))
    write_ply(path, {"vertex": Rows(dtype, count, blocks)}, [f"class {i} {name}" for i, name in enumerate(class_names)])


def _ply_rows(cloud: GaussianCloud, rows: slice, dtype: np.dtype, occurring: list[int]) -> NDArray[Any]:
    part = cloud.only(np.arange(len(cloud))[rows])
    if not np.isfinite(part.means).all():
        raise ValueError("write_gaussian_ply: x, y or z holds a value that is not finite")
    base = (part.colors - np.float32(0.5)) / np.float32(SH_C0)
    columns = (part.means, np.zeros_like(part.means), base, part.opacity_logits, part.log_scales, part.quat_wxyz)
    vertex = np.zeros(len(part), dtype=dtype)
    for name, column in zip(_PLY_FIELDS, np.column_stack(columns).T, strict=True):
        vertex[name] = column
    if part.class_ids is not None:
        vertex["class_id"] = part.class_ids
    for i in occurring if part.class_probs is not None else ():
        vertex[f"class_prob_{i}"] = part.class_probs[:, i]  # type: ignore[index]
    if part.things is not None:
        vertex["thing"] = part.things
    return vertex


# GLB --------------------------------------------------------------------------------------------------------------


def write_gaussian_glb(path: Path, cloud: GaussianCloud, class_names: tuple[str, ...] = ()) -> None:
    """Write a cloud, its class numbers as attribute _LABEL and their names in the mesh's extras.

    Nothing is rounded. The same cloud gives the same bytes. Raises ValueError for an empty cloud, which glTF cannot
    hold, InputError when the disk refuses.
    """
    if len(cloud) == 0:
        raise ValueError("write_gaussian_glb: glTF has no way to store an empty cloud")
    opacity = cloud.opacities().astype(np.float32)
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": cloud.means * _FLIP,
        "COLOR_0": np.column_stack([linear(cloud.colors), opacity]),
        f"{EXTENSION}:ROTATION": _quat_xyzw_up(cloud),
        f"{EXTENSION}:SCALE": np.exp(cloud.log_scales),
        f"{EXTENSION}:OPACITY": opacity,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (cloud.colors - np.float32(0.5)) / np.float32(SH_C0),
    }
    if cloud.class_ids is not None:
        arrays[LABEL] = cloud.class_ids.astype(np.float32)
    parts = [Part.of(name, array) for name, array in arrays.items()]
    primitive = {"mode": 0, "material": 0, "extensions": {EXTENSION: _PROPERTIES}}
    write_primitive(path, parts, primitive, class_names, {}, {"materials": [material()]}, [EXTENSION, UNLIT])


def write_compressed_glb(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud's colours as `write_gaussian_glb` does, compressed: rounded as SPZ rounds, without classes.

    Raises ValueError for an empty cloud or places that SPZ cannot hold, InputError when the disk refuses.
    """
    if len(cloud) == 0:
        raise ValueError("write_compressed_glb: glTF has no way to store an empty cloud")
    packed, positions = spz_bytes(cloud, 2), Part.of("POSITION", cloud.means * _FLIP).accessor()
    floats = {"componentType": positions["componentType"], "count": len(cloud)}
    accessors = {
        "POSITION": positions,
        "COLOR_0": {**floats, "type": "VEC4", "componentType": 5121, "normalized": True},
        f"{EXTENSION}:SCALE": {**floats, "type": "VEC3"},
        f"{EXTENSION}:ROTATION": {**floats, "type": "VEC4"},
    }
    properties = {**_PROPERTIES, "extensions": {COMPRESSION: {"bufferView": 0}}}
    attributes = {name: number for number, name in enumerate(accessors)}
    mesh = {"primitives": [{"mode": 0, "attributes": attributes, "extensions": {EXTENSION: properties}}]}
    views, both = [{"buffer": 0, "byteLength": len(packed)}], [EXTENSION, COMPRESSION]
    extensions = {"extensionsUsed": both, "extensionsRequired": both}
    write_glb(
        path, glb_document(extensions, [mesh], [{}], {}, list(accessors.values()), views, len(packed)), [], packed
    )


def _quat_xyzw_up(cloud: GaussianCloud) -> NDArray[np.float32]:
    """(M, 4) rotations into the axes of glTF and SPZ."""
    return cloud.quat_wxyz[:, [1, 2, 3, 0]] * np.append(_FLIP, np.float32(1))


# SPZ --------------------------------------------------------------------------------------------------------------


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
    bits = max(0, min(16, 21 - int(np.floor(np.log2(max(extent, 1e-9))))))
    # Three little-endian 24 bit two's complement numbers a Gaussian.
    fixed = np.floor((cloud.means * _FLIP).astype(np.float64) * 2**bits + 0.5).astype("<i4")
    streams = [
        fixed.view(np.uint8).reshape(len(cloud), 3, 4)[:, :, :3].tobytes(),
        _byte(cloud.opacities() * 255).tobytes(),
        _byte((cloud.colors - 0.5) / SH_C0 * (_SPZ_COLOR_SCALE * 255) + 0.5 * 255).tobytes(),
        _byte((cloud.log_scales + 10) * 16).tobytes(),
        _packed_rotations(_quat_xyzw_up(cloud), version).tobytes(),
    ]
    if version == 2:
        out = io.BytesIO()
        with gzip.GzipFile(fileobj=out, mode="wb", mtime=0) as file:  # 0: the clock must not get into the file
            file.write(_SPZ_HEADER.pack(b"NGSP", 2, len(cloud), 0, bits, 0, 0) + b"".join(streams))
        return out.getvalue()
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in streams]
    header = _SPZ_HEADER_4.pack(b"NGSP", 4, len(cloud), 0, bits, 0, len(streams), _SPZ_HEADER_4.size)
    table = [struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    return b"".join([header, *table, *packed])


def _byte(values: NDArray) -> NDArray[np.uint8]:
    return np.floor(values + 0.5).clip(0, 255).astype(np.uint8)


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


# SOG --------------------------------------------------------------------------------------------------------------


def write_sog(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud without view-dependent colour; classes are not kept.

    Positions are 16 bits of the logarithm between the smallest and the largest; scales and colours the nearest of 256
    values each; opacity and the parts of a rotation 8 bits. Neighbours are adjacent (Morton's order), which
    packs. The same cloud gives the same bytes. Raises ValueError for an empty cloud, InputError when the disk refuses.
    """
    if len(cloud) == 0:
        raise ValueError("write_sog: a cloud without Gaussians cannot be written")
    means = cloud.means.astype(np.float64)
    order = morton_order(means)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.round((logs - low) / np.maximum(high - low, 1e-12) * 65535).astype(np.uint16)
    scales, scale_bytes = _codebook(cloud.log_scales.astype(np.float64))
    colors, color_bytes = _codebook((cloud.colors.astype(np.float64) - 0.5) / SH_C0)
    pictures = {
        "means_l": _opaque((steps & 255).astype(np.uint8)),
        "means_u": _opaque((steps >> 8).astype(np.uint8)),
        "scales": _opaque(scale_bytes),
        "quats": _quaternion_bytes(cloud.quat_wxyz.astype(np.float64)),
        "sh0": np.column_stack([color_bytes, np.round(255 * cloud.opacities()).astype(np.uint8)]),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "msgs-slam"},
        "count": len(cloud),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colors.tolist(), "files": ["sh0.webp"]},
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, values in pictures.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp"), _picture(values[order]))
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta).encode())
    write_bytes(path, out.getvalue())


def _codebook(values: Array) -> tuple[Array, NDArray[np.uint8]]:
    """256 values for all (M, 3), and the index of the nearest for each: k-means, initialised half by quantiles and half
    uniformly so that rare values are kept."""
    flat, even = values.ravel(), np.linspace(0, 1, _LEVELS // 2)
    book = np.sort(np.append(np.quantile(flat, even), flat.min() + np.ptp(flat) * even))
    for _ in range(_ROUNDS):
        nearest = np.searchsorted((book[1:] + book[:-1]) / 2, flat)
        count, total = np.bincount(nearest, minlength=_LEVELS), np.bincount(nearest, flat, _LEVELS)
        book = np.sort(np.where(count > 0, total / np.maximum(count, 1), book))
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def _quaternion_bytes(quat_wxyz: Array) -> NDArray[np.uint8]:
    """(M, 4): all but the largest of w, x, y, z, which is made positive, and which that is."""
    largest = np.abs(quat_wxyz).argmax(axis=1)
    rows = np.arange(len(quat_wxyz))
    turned = quat_wxyz * np.where(quat_wxyz[rows, largest] < 0, -1, 1)[:, None]
    others = np.array([[k for k in range(4) if k != dropped] for dropped in range(4)])[largest]
    parts = np.round((turned[rows[:, None], others] * np.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.column_stack([parts, _FIRST_QUATERNION_KIND + largest]).astype(np.uint8)


def morton_order(means: Array) -> NDArray[np.int64]:
    """Return (M,) rows along a curve that leaves small cubes last; ties as they came."""
    low, high = means.min(axis=0), means.max(axis=0)
    cells = ((means - low) / np.maximum(high - low, 1e-12) * ((1 << _MORTON_BITS) - 1)).astype(np.int64)
    return np.argsort(morton_codes(cells), kind="stable")


def morton_codes(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return (M,) the bits of the coordinates (M, 3), 0 to 2^21 - 1, in turn (Morton 1966)."""
    cells, codes = cells.astype(np.int64), np.zeros(len(cells), np.int64)
    for bit in range(21):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes


def _opaque(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.column_stack([rgb, np.full(len(rgb), 255, np.uint8)])


def _picture(rgba: NDArray[np.uint8]) -> bytes:
    """A lossless WebP about as wide as high, its sides multiples of four; what is over is empty."""
    width = 4 * int(np.ceil(np.sqrt(len(rgba)) / 4))
    height = 4 * int(np.ceil(len(rgba) / width / 4))
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[: len(rgba)] = rgba
    out = io.BytesIO()
    # exact: the colours of transparent pixels count.
    Image.fromarray(pixels.reshape(height, width, 4)).save(out, format="WEBP", lossless=True, exact=True)
    return out.getvalue()
