"""A small file for a Gaussian map: about 25 bytes a Gaussian, whatever the number of classes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gaussians import GaussianCloud, parts_of, unit_quaternions
from msgs_slam.formats.reading import parsing
from msgs_slam.formats.tensors import load_safetensors, save_safetensors

KEPT_CLASSES = 4
"""The most probable classes of each Gaussian that are kept; the rest shares what is left equally."""

_FORMAT = "gaussians-compact-1"
_STEPS = 65535
_MOST_CLASSES = 255
_AT_ONCE = 1 << 16
"""Gaussians that are packed at a time: in double precision, and sorted by class, they take many times their room."""


def write_compact(
    path: Path, cloud: GaussianCloud | Sequence[GaussianCloud], class_names: tuple[str, ...] = ()
) -> None:  # fmt: skip
    """Write isotropic or general Gaussians, or the parts of such a cloud, into a .safetensors file of quantised arrays.

    Means: 16 bits over the bounding box, an error of at most its side / 131070. Scales and opacity: half precision.
    Colours: 8 bits, clipped to 0..1. Classes: the `KEPT_CLASSES` most probable, with 8 bit probabilities.
    Rotations are left out where all three scales are equal. Raises InputError when the disk refuses.
    """
    parts, corners, isotropic, count = parts_of(cloud), [], True, 0
    for part in parts:
        corners += [part.means.min(axis=0), part.means.max(axis=0)] if len(part) else []
        isotropic &= bool((part.log_scales == part.log_scales[:, :1]).all())
        count = 0 if part.class_probs is None else part.class_probs.shape[1]
    low, side = _bounds(corners)
    packed = [_packed(part, low, side, isotropic) for part in parts]
    arrays = {name: np.concatenate([p[name] for p in packed]) for name in packed[0]}
    meta = {"format": _FORMAT, "class_count": str(count), "class_names": "\n".join(class_names)}
    save_safetensors(path, arrays | {"box": np.stack([low, side])}, meta)


def _packed(
    cloud: GaussianCloud, low: NDArray[np.float64], side: NDArray[np.float64], isotropic: bool
) -> dict[str, NDArray]:  # fmt: skip
    """The arrays of one part."""
    arrays: dict[str, NDArray] = {
        "means": np.concatenate([_quantised(cloud.means[rows], low, side) for rows in _parts(len(cloud))]),
        "log_scales": cloud.log_scales[:, :1].astype(np.float16) if isotropic else cloud.log_scales.astype(np.float16),
        "opacity_logits": cloud.opacity_logits.astype(np.float16),
        "colors": np.round(cloud.colors.clip(0, 1) * 255).astype(np.uint8),
    }
    if not isotropic:
        arrays["quat_wxyz"] = cloud.quat_wxyz.astype(np.float16)
    if cloud.class_probs is not None:
        arrays["top_classes"], arrays["top_probs"] = _top_classes(cloud.class_probs)
    return arrays


def read_compact(path: Path) -> tuple[GaussianCloud, tuple[str, ...]]:
    """The cloud, to the precision `write_compact` states, and the class names. Raises InputError for another file."""
    arrays, meta = load_safetensors(path)
    if meta.get("format") != _FORMAT:
        raise InputError(f"{path} is no compact Gaussian file: expected one written with the map's compact export")
    with parsing(path, "compact Gaussian file", "export it again"):
        cloud = _unpacked(arrays, int(meta["class_count"]))
    names = meta.get("class_names", "")
    return cloud, tuple(names.split("\n")) if names else ()


def _unpacked(arrays: dict[str, NDArray], class_count: int) -> GaussianCloud:
    if not 0 <= class_count <= _MOST_CLASSES:
        raise ValueError(f"{class_count} classes")
    low, side = arrays["box"]
    m = len(arrays["means"])
    scales = arrays["log_scales"].astype(np.float32)
    identity = np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (m, 1))
    probs = None
    if class_count:
        probs = _spread_classes(arrays["top_classes"], arrays["top_probs"], class_count)
    return GaussianCloud(
        means=(arrays["means"] / _STEPS * side + low).astype(np.float32),
        log_scales=np.repeat(scales, 3, axis=1) if scales.shape[1] == 1 else scales,
        quat_wxyz=unit_quaternions(arrays["quat_wxyz"]) if "quat_wxyz" in arrays else identity,
        opacity_logits=arrays["opacity_logits"].astype(np.float32),
        colors=arrays["colors"].astype(np.float32) / np.float32(255),
        class_ids=arrays["top_classes"][:, 0] if probs is not None else None,
        class_probs=probs,
    )


def _bounds(corners: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest corner and side lengths of the box around points, a side of 0 replaced by 1."""
    if not corners:
        return np.zeros(3), np.ones(3)
    low, high = np.min(corners, axis=0).astype(np.float64), np.max(corners, axis=0).astype(np.float64)
    return low, np.where(high > low, high - low, 1.0)


def _quantised(means: NDArray[np.float32], low: NDArray[np.float64], side: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.round((means.astype(np.float64) - low) / side * _STEPS).astype(np.uint16)


def _top_classes(probs: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """(M, k) ids and 8 bit probabilities, most probable first; equal ones by id."""
    ids = np.empty((len(probs), min(KEPT_CLASSES, probs.shape[1])), np.uint8)
    values = np.empty(ids.shape, np.uint8)
    for rows in _parts(len(probs)):
        order = np.argsort(-probs[rows], axis=1, kind="stable")[:, : ids.shape[1]]
        best = np.take_along_axis(probs[rows], order, axis=1).clip(0, 1)
        ids[rows], values[rows] = order, np.floor(best * 255 + 0.5)
    return ids, values


def _parts(count: int) -> list[slice]:
    """At least one, so that none of nothing can be joined too."""
    return [slice(start, start + _AT_ONCE) for start in range(0, max(count, 1), _AT_ONCE)]


def _spread_classes(ids: NDArray[np.uint8], values: NDArray[np.uint8], count: int) -> NDArray[np.float32]:
    """(M, C) probabilities that sum to 1: the kept ones, and equal shares of what they leave for the others."""
    kept = values.astype(np.float32) / np.float32(255)
    others = count - ids.shape[1]
    total = kept.sum(axis=1, keepdims=True)
    kept = kept / np.maximum(total, 1) if others else kept / np.maximum(total, np.float32(1e-6))
    rest = np.maximum(0, 1 - kept.sum(axis=1, keepdims=True)) / max(others, 1)
    probs = np.repeat(rest.astype(np.float32), count, axis=1)
    np.put_along_axis(probs, ids.astype(np.int64), kept.astype(np.float32), axis=1)
    return probs
