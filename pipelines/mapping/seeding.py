"""New Gaussians from the pixels of a view, at its depth."""

import math
from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..render.gaussian_map import GaussianMap
from ..types import Intrinsics

SEED_OPACITY = 0.73
SEED_RADIUS = 0.7
"""Radius of a seed in units of the distance between seeds on the image: neighbours then overlap without blurring."""
SEED_LOGIT = 3.0
"""Logit of a seed's own class against 0 for the others."""
MIN_DETAIL = 8.0
"""Colours that differ by less, of 255, are no detail however little else there is."""


@dataclass(frozen=True)
class SeedDepth:
    """depth (H, W) float32, 0 = nowhere known; trust (H, W) 0..1."""

    depth: NDArray[np.float32]
    trust: NDArray[np.float32]


def complete_depth(depth: NDArray[np.float32], trust: NDArray[np.float32]) -> SeedDepth:
    """A depth for every pixel of (H, W), 0 = unknown: what is unknown is filled from around it, and not trusted."""
    known = depth > 0
    if not known.any():
        return SeedDepth(np.zeros_like(depth), np.zeros_like(depth))
    inverse, trust = np.divide(1, depth, out=np.zeros_like(depth), where=known), np.where(known, trust, 0)
    filled = np.where(known, inverse, fill_smoothly(inverse, trust))
    return SeedDepth((1.0 / np.maximum(filled, 1e-9)).astype(np.float32), trust)


def fill_smoothly(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) a smooth continuation of the values > 0: coarser and coarser weighted means until all is covered."""
    known = np.where(values > 0, np.maximum(weights, 1e-3), 0).astype(np.float32)
    levels = [(values * known, known)]
    while min(levels[-1][0].shape) > 2:
        total, weight = (cv2.pyrDown(a).astype(np.float32) for a in levels[-1])
        levels.append((total, weight))
    filled = np.full_like(levels[-1][0], float(levels[-1][0].sum() / max(levels[-1][1].sum(), 1e-12)))
    for total, weight in reversed(levels):
        coarse = cv2.resize(filled, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
        share = np.clip(weight / 0.05, 0, 1)
        mean = np.divide(total, weight, out=coarse.copy(), where=weight > 1e-6)
        filled = share * mean + (1 - share) * coarse
    return filled


def seed_gaussians(
    pixels: Tensor,
    depth: Tensor,
    colors: Tensor,
    channels: Tensor,
    spacing: float | Tensor,
    classes: int,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    frame_id: int,
) -> GaussianMap:
    """One Gaussian for each marked pixel with a depth.

    pixels (H, W) bool, depth (H, W), colors (H, W, 3) 0..1, channels (H, W) uint8, spacing: pixels between neighbours,
    one number or (H, W).
    """
    rows, columns = torch.nonzero(pixels & (depth > 0), as_tuple=True)
    z = depth[rows, columns]
    x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx * z
    y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy * z
    world_from_cam = torch.linalg.inv(cam_from_world).to(z.device)
    in_world = torch.stack([x, y, z], 1).double() @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    focal = math.sqrt(intrinsics.fx * intrinsics.fy)
    if isinstance(spacing, Tensor):
        spacing = spacing[rows, columns]
    channel = channels[rows, columns].long()
    logits = torch.zeros(len(z), classes + 1, device=z.device)
    # Void pixels write into a column of their own, which is cut off.
    logits[torch.arange(len(z), device=z.device), channel.clamp(max=classes)] = SEED_LOGIT
    return GaussianMap(
        means=in_world.float(),
        log_radii=torch.log(z / focal * (spacing * SEED_RADIUS)),
        opacity_logits=torch.full_like(z, math.log(SEED_OPACITY / (1 - SEED_OPACITY))),
        colors=colors[rows, columns].float(),
        class_logits=logits[:, :classes].contiguous(),
        anchor_frame_ids=torch.full((len(z),), frame_id, dtype=torch.int64, device=z.device),
    )


def seed_spacing(
    image: NDArray[np.uint8], depth: NDArray[np.float32], stride: int, fine_share: float, flat_share: float
) -> NDArray[np.float32]:
    """(H, W) where to seed: the distance in pixels to the next seed, 0 = no seed here.

    image (H, W, 3), depth (H, W). A seed every `stride` pixels; one every pixel in the `fine_share` of the
    cells with the most detail, one every 2 * stride in the `flat_share` with the least. Depth steps are never flat.
    Shares instead of thresholds: what counts as detail depends on the noise of the camera.
    """
    height, width = depth.shape
    out = np.zeros((height, width), np.float32)
    out[seed_grid(height, width, stride)] = stride
    detail = _detail(image)
    if flat_share > 0:
        side = 2 * stride
        flat = _cells(detail, side) <= np.quantile(detail[::2, ::2], flat_share)
        flat &= ~_cells(_steps(depth), side).astype(bool)
        _refill(out, flat, side, float(side), side // 2)
    if fine_share > 0 and stride > 1:
        cells = _cells(detail, stride)
        fine = cells > max(float(np.quantile(cells, 1 - fine_share)), MIN_DETAIL)
        _refill(out, fine, stride, 1.0, None)
    return out


def _detail(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W) range of the colours around every pixel, 0..255, after a slight blur that takes the camera's noise."""
    soft = cv2.GaussianBlur(image, (0, 0), 0.7)
    square = np.ones((3, 3), np.uint8)
    return (cv2.dilate(soft, square).astype(np.float32) - cv2.erode(soft, square)).max(-1)


def _steps(depth: NDArray[np.float32], tolerance: float = 0.04) -> NDArray[np.float32]:
    """(H, W) 1 beside a depth step or where the depth is unknown."""
    square = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, square), cv2.dilate(depth, square)
    return (high - low > tolerance * high).astype(np.float32)


def _cells(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """(ceil(H / side), ceil(W / side)) largest value in each square."""
    height, width = values.shape
    padded = np.pad(values, ((0, -height % side), (0, -width % side)), mode="edge")
    return reduce(np.maximum, (padded[i::side, j::side] for i in range(side) for j in range(side)))


def _refill(out: NDArray[np.float32], cells: NDArray[np.bool_], side: int, spacing: float, middle: int | None) -> None:
    """In the marked cells: one seed in the middle, or (None) one at every pixel."""
    height, width = out.shape
    inside = np.repeat(np.repeat(cells, side, axis=0), side, axis=1)[:height, :width]
    if middle is None:
        out[inside] = spacing
        return
    out[inside] = 0
    grid = np.zeros_like(inside)
    grid[middle::side, middle::side] = True
    out[inside & grid] = spacing


def seed_grid(height: int, width: int, stride: int) -> NDArray[np.bool_]:
    """(H, W) every stride-th pixel of every stride-th row, centred in its cell."""
    grid = np.zeros((height, width), bool)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    return grid
