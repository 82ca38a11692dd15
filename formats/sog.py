"""SOG, PlayCanvas's splat file for the web: images in which a pixel is a Gaussian, and what their bytes mean.

Version 2 by developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, all files in one archive. Its axes are
in practice those of splat PLYs (x right, y down, z forward): so its own converter writes what it reads of SPZ.
"""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .atomic import write_bytes
from .gaussians import GaussianCloud
from .ply import SH_C0

Array = NDArray[np.float64]

_LEVELS = 256
_ROUNDS = 10
_FIRST_QUATERNION_KIND = 252
_MORTON_BITS = 10


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
    opacity = np.round(255 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))).astype(np.uint8)
    pictures = {
        "means_l": _opaque((steps & 255).astype(np.uint8)),
        "means_u": _opaque((steps >> 8).astype(np.uint8)),
        "scales": _opaque(scale_bytes),
        "quats": _quaternion_bytes(cloud.quat_wxyz.astype(np.float64)),
        "sh0": np.column_stack([color_bytes, opacity]),
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
    files = {f"{name}.webp": _picture(values[order]) for name, values in pictures.items()}
    write_bytes(path, _archive(files | {"meta.json": json.dumps(meta).encode()}))


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


def _archive(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()
