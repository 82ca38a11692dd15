"""Depth by a network."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.camera import unproject_depth
from ..geometry.voxels import normals_in_cam
from ..types import Intrinsics
from .session import Letterbox, Network

_ALIKE = np.radians(30)
_MIN_COSINE = 0.7


PLAIN_CONFIDENCE = 0.5
"""Confidence of a network that gives none of its own."""


@dataclass(frozen=True)
class NetworkDepth:
    """depth, confidence (h, w); `invalid` values were NaN or negative; normals (h, w, 3) int8 in 127ths that face the
    camera, and the focal length in pixels that the network's own points imply, where it gives them."""

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    invalid: int
    normals: NDArray[np.int8] | None = None
    focal: float | None = None


def network_depth(network: Network, image: NDArray[np.uint8], intrinsics: Intrinsics) -> NetworkDepth:
    """Depth of an RGB image with these intrinsics.

    A canonical depth becomes metres by the focal length of the image as the network saw it: `z = d · f / f_canonical`
    (Metric3D, Yin et al., ICCV 2023). Values at the network's stops, NaN and negative ones are unknown.
    Raises InputError when the output is no image of depth.
    """
    card = network.card
    box = network.box(intrinsics.width, intrinsics.height)
    outputs = network.run(image, box)
    focal = None
    if card.kind == "points":
        raw, focal = points_depth(network, outputs, box, intrinsics)
    else:
        raw = _plane(network, outputs["output"])
    broken = ~np.isfinite(raw) | (raw < 0)
    bad = broken | (raw <= card.valid[0]) | (raw >= card.valid[1])
    # Bilinear reading must not mix invalid values in: a pixel is known when all that it is made of is.
    depth = box.take(np.where(bad, 0, raw).astype(np.float32), card.align_corners)
    if bad.any():
        depth[box.take(bad.astype(np.float32), card.align_corners) > 1e-3] = 0
    if card.canonical_focal:
        scale_x, scale_y = box.scale
        depth *= np.float32((intrinsics.fx * scale_x + intrinsics.fy * scale_y) / 2 / card.canonical_focal)
    normals = _normals(network, outputs, box, depth, intrinsics)
    if "confidence" in outputs:
        given = np.nan_to_num(_plane(network, outputs["confidence"]), nan=0.0)
        confidence = box.take(np.clip(given, 0, 1), card.align_corners)
    else:
        kappa = box.take(_plane(network, outputs["kappa"]), card.align_corners) if "kappa" in outputs else None
        confidence = plain_confidence(depth, normals, kappa, intrinsics)
    known = (confidence * (depth > 0)).astype(np.float32)
    stored = None if normals is None else np.round(normals * 127).astype(np.int8)
    return NetworkDepth(depth, known, int(broken.sum()), stored, focal)


def plain_confidence(
    depth: NDArray[np.float32], normals: NDArray[np.float32] | None, kappa: NDArray | None, intrinsics: Intrinsics
) -> NDArray[np.float32]:
    """(h, w) confidence of a depth whose network says nothing of it: a half where its two answers, the normals and
    the slope of the depth, agree, down to a quarter where they do not; a quarter up or down by how sure the normals
    are (a weak cue: `kappa` has no scale of its own)."""
    confidence = np.full(depth.shape, PLAIN_CONFIDENCE, np.float32)
    if normals is None:
        return confidence
    slope = normals_in_cam(depth, intrinsics)
    cosine = (slope * normals).sum(-1)
    agree = np.exp(-((np.arccos(np.clip(cosine, -1, 1)) / _ALIKE) ** 2))
    confidence = confidence * np.where(np.abs(slope).sum(-1) > 0, 0.5 + 0.5 * agree, 0.75)
    if kappa is not None:
        sure = np.maximum(np.nan_to_num(kappa, nan=0.0, posinf=0.0), 0)
        confidence = confidence * (0.75 + 0.5 * sure / (sure + max(float(np.median(sure)), 1e-9)))
    return confidence.astype(np.float32)


def _normals(
    network: Network, outputs: dict[str, NDArray], box: Letterbox, depth: NDArray[np.float32], intrinsics: Intrinsics
) -> NDArray[np.float32] | None:
    """(h, w, 3) unit normals that face the camera; None where the network gives none, or none that fit its depth
    (then its axes are not ours)."""
    given = outputs.get("normals")
    if given is None or given.ndim != 3 or 3 not in (given.shape[0], given.shape[2]):
        return None
    given = given if given.shape[2] == 3 else given.transpose(1, 2, 0)
    normals = box.take(np.nan_to_num(given).astype(np.float32), network.card.align_corners)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 0.1, normals / np.maximum(length, 1e-6), 0).astype(np.float32)
    rays = unproject_depth(np.ones(depth.shape), intrinsics)
    normals = np.where((normals * rays).sum(-1, keepdims=True) > 0, -normals, normals)
    slope = normals_in_cam(depth, intrinsics)
    both = (np.abs(slope).sum(-1) > 0) & (np.abs(normals).sum(-1) > 0)
    if not both.any() or np.median((slope * normals).sum(-1)[both]) < _MIN_COSINE:
        return None
    return normals.astype(np.float32)


def _plane(network: Network, output: NDArray) -> NDArray[np.float32]:
    """(h', w') of an output that may carry a channel axis of length 1."""
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2 or min(plane.shape) < 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of depth is expected")
    return plane.astype(np.float32)


def points_depth(
    network: Network, outputs: dict[str, NDArray], box: Letterbox, intrinsics: Intrinsics
) -> tuple[NDArray[np.float32], float | None]:
    """(h', w') depth in metres of an affine-invariant point map (h', w', 3), 0 outside its mask, and the focal length
    in pixels that it implies by itself.

    The network knows z only up to a shift, which the known focal length settles (MoGe, Wang et al., CVPR 2025).
    """
    card = network.card
    points = outputs["output"].astype(np.float64)
    if points.ndim != 3 or points.shape[2] != 3 or min(points.shape[:2]) < 2:
        raise InputError(f"{card.model}: gave {points.shape} where an image of points is expected")
    valid = np.isfinite(points).all(-1)
    if "mask" in outputs:
        valid &= _plane(network, outputs["mask"]) > 0.5
    if valid.sum() < 16:
        return np.zeros(valid.shape, np.float32), None
    rays = _rays(box, intrinsics, valid.shape)[valid]
    shift = solve_shift(points[valid], rays)
    _, focal = solve_shift_and_focal(points[valid][::7], rays[::7] * intrinsics.fx)
    scale = float(np.ravel(outputs["metric_scale"])[0]) if "metric_scale" in outputs else 1.0
    return np.where(valid, (points[..., 2] + shift) * scale, 0).astype(np.float32), focal


def solve_shift(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    """The s for which points (P, 3) with z + s are on their rays (P, 2), x/z and y/z: robust least squares."""
    weight = np.ones(len(points))
    shift = 0.0
    for _ in range(10):
        gap = points[:, :2] - points[:, 2:] * rays
        shift = float((weight[:, None] * rays * gap).sum() / max((weight[:, None] * rays**2).sum(), 1e-12))
        residual = np.linalg.norm(gap - shift * rays, axis=1)
        weight = 1 / (1 + (residual / (2 * np.median(residual) + 1e-9)) ** 2)
    return shift


def solve_shift_and_focal(points: NDArray[np.float64], pixels: NDArray[np.float64]) -> tuple[float, float]:
    """(shift, focal in pixels) of points (P, 3) seen at `pixels` (P, 2) from the principal point, focal unknown.

    Every point says `f · x - s · u = u · z`; two unknowns, solved by robust least squares.
    """
    rows = np.concatenate([np.stack([points[:, a], -pixels[:, a]], -1) for a in (0, 1)])
    right = np.concatenate([pixels[:, a] * points[:, 2] for a in (0, 1)])
    weight = np.ones(len(right))
    focal, shift = 1.0, 0.0
    for _ in range(10):
        focal, shift = np.linalg.lstsq(rows * weight[:, None], right * weight, rcond=None)[0]
        residual = np.abs(rows @ (focal, shift) - right)
        weight = 1 / (1 + (residual / (2 * np.median(residual) + 1e-9)) ** 2)
    return float(shift), float(focal)


def _rays(box: Letterbox, intrinsics: Intrinsics, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(h', w', 2) x/z and y/z of every pixel of the network's output."""
    u = (np.arange(shape[1]) + 0.5) * box.box_width / shape[1]
    v = (np.arange(shape[0]) + 0.5) * box.box_height / shape[0]
    x = ((u - box.offset[0]) / box.scale[0] - intrinsics.cx) / intrinsics.fx
    y = ((v - box.offset[1]) / box.scale[1] - intrinsics.cy) / intrinsics.fy
    return np.stack(np.meshgrid(x, y), axis=-1)
