"""Splat files of every kind that can be read here."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .gaussian_glb import read_gaussian_glb
from .gaussians import GaussianCloud, unit_quaternions
from .ply import read_gaussian_ply
from .reading import parsing, read_bytes
from .spz import read_spz

_SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])
_SMALLEST_SCALE = 1e-9


def read_gaussians(path: Path) -> GaussianCloud:
    """Read the Gaussians of a .ply, .spz, .splat or .glb file, by its suffix.

    Raises InputError for another suffix, a missing or damaged file, and values that are not finite.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".ply":
        return read_gaussian_ply(path)
    if kind == ".spz":
        return read_spz(path)
    if kind == ".splat":
        return read_splat(path)
    if kind == ".glb":
        return read_gaussian_glb(path)
    raise InputError(f"{path} has an unsupported extension; expected .ply, .spz, .splat or .glb")


def read_splat(path: Path) -> GaussianCloud:
    """Read the Gaussians of a .splat file: 32 bytes each, without header, 8 bit colours and rotations.

    Raises InputError when the file is missing, its length is no multiple of 32, or a value is not finite.
    """
    data = read_bytes(path)
    if len(data) % _SPLAT_ROW.itemsize:
        raise InputError(f"{path} is no whole .splat file (32 bytes for each Gaussian): copy or export it again")
    with parsing(path, ".splat file"):
        return _unpacked(np.frombuffer(data, dtype=_SPLAT_ROW))


def _unpacked(rows: NDArray) -> GaussianCloud:
    opacity = (rows["rgba"][:, 3] / 255.0).clip(1e-4, 1 - 1e-4)
    return GaussianCloud(
        means=rows["mean"].astype(np.float32),
        log_scales=np.log(np.maximum(rows["scale"], _SMALLEST_SCALE)).astype(np.float32),
        quat_wxyz=unit_quaternions(rows["quat_wxyz"] / 128.0 - 1),
        opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        colors=(rows["rgba"][:, :3] / 255.0).astype(np.float32),
    )
