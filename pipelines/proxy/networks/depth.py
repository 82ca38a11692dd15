"""Depth by a network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.proxy.networks.letterbox import Letterbox
from pipelines.proxy.networks.session import Network
from pipelines.types import Intrinsics


def network_depth(
    network: Network, image: NDArray[np.uint8], intrinsics: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None, int]:
    """(depth (h, w), confidence (h, w) or None, number of invalid values) of an RGB image with these intrinsics.

    A canonical depth becomes metres by the focal length of the picture as the network saw it: `z = d · f / f_canonical`
    (Metric3D, Yin et al., ICCV 2023). Values at the network's stops, NaN and negative ones are unknown.
    Raises InputError when the output is no image of depth.
    """
    card = network.card
    box = network.box(intrinsics.width, intrinsics.height)
    outputs = network.run(image, box)
    is_plane = card.kind != "points"
    raw = _plane(network, outputs[0]) if is_plane else points_depth(network, outputs, box, intrinsics)
    broken = ~np.isfinite(raw) | (raw < 0)
    bad = broken | (raw <= card.valid[0]) | (raw >= card.valid[1])
    # Bilinear reading must not mix invalid values in: a pixel is known when all that it is made of is.
    depth = box.take(np.where(bad, 0, raw).astype(np.float32), card.align_corners)
    if bad.any():
        depth[box.take(bad.astype(np.float32), card.align_corners) > 1e-3] = 0
    if card.canonical_focal:
        scale_x, scale_y = box.scale
        depth *= np.float32((intrinsics.fx * scale_x + intrinsics.fy * scale_y) / 2 / card.canonical_focal)
    confidence = None
    if card.confidence:
        given = np.nan_to_num(_plane(network, outputs[1]), nan=0.0)
        confidence = box.take(np.clip(given, 0, 1), card.align_corners) * (depth > 0)
    return depth, confidence, int(broken.sum())


def _plane(network: Network, output: NDArray) -> NDArray[np.float32]:
    """(h', w') of an output that may carry a channel axis of length 1."""
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2 or min(plane.shape) < 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of depth is expected")
    return plane.astype(np.float32)


def points_depth(
    network: Network, outputs: list[NDArray], box: Letterbox, intrinsics: Intrinsics
) -> NDArray[np.float32]:
    """(h', w') depth in metres of an affine-invariant point map (h', w', 3), 0 outside its mask.

    The network knows z only up to a shift, which the known focal length settles (MoGe, Wang et al., CVPR 2025).
    """
    card = network.card
    points = outputs[0].astype(np.float64)
    rest = dict(zip([n for n in (card.confidence, card.mask, card.metric_scale) if n], outputs[1:], strict=True))
    if points.ndim != 3 or points.shape[2] != 3 or min(points.shape[:2]) < 2:
        raise InputError(f"{card.model}: gave {points.shape} where an image of points is expected")
    valid = np.isfinite(points).all(-1)
    if card.mask:
        valid &= _plane(network, rest[card.mask]) > 0.5
    if valid.sum() < 16:
        return np.zeros(valid.shape, np.float32)
    shift = solve_shift(points[valid], _rays(box, intrinsics, valid.shape)[valid])
    scale = float(np.ravel(rest[card.metric_scale])[0]) if card.metric_scale else 1.0
    return np.where(valid, (points[..., 2] + shift) * scale, 0).astype(np.float32)


def solve_shift(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    """The s for which points (P, 3) with z + s lie on their rays (P, 2), x/z and y/z: robust least squares."""
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
