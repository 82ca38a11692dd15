"""Gaussian splat PLY in the layout of the original 3D Gaussian splatting (Kerbl et al. 2023)."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData

from .errors import InputError
from .gaussians import GaussianCloud, parts_of, unit_quaternions
from .ply_table import Rows, columns, read_ply, slices, write_ply
from .reading import parsing

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi)): colour = 0.5 + SH_C0 * f_dc."""

_REST_COUNTS = {0: 0, 1: 9, 2: 24, 3: 45}
_MEANS, _NORMALS, _DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES, _ROTATION = ["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]
_PROB = "class_prob_"


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
    """The Gaussians of a PLY by this or another program, of any spherical-harmonic degree.

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


def _cloud(ply: PlyData, path: Path) -> GaussianCloud:
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
