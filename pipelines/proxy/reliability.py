"""Reliability of proxy depth per pixel: MSGS-SLAM eq. (2) and (3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.types import VOID, Intrinsics

ALPHA, BETA, GAMMA = 0.7, 0.8, 0.5
"""Eq. (2): how much depth edges lower the reliability; exponents of the depth's confidence and of the agreement."""
SLOPE, MIDDLE = 10.0, 0.3
"""Eq. (3): λ, steepness of the semantic agreement, and φ, the agreement (mean IoU) that counts one half."""
EDGE_STEP = 0.1
"""Unit of the log-depth gradient: a change of depth by 10 % from one pixel to the next. A wall or floor seen at an
angle stays far below it, an occlusion edge far above."""
_BLOCK = 256
"""Label images that are compared at once."""


def reliability(depth: NDArray[np.float32], confidence: NDArray[np.float32], theta: float) -> NDArray[np.float32]:
    """MSGS-SLAM eq. (2): `U = exp(-α‖∇ log D‖²) · Conf^β · θ^γ`, (h, w) in [0, 1]; 0 where the depth is unknown.

    The gradient is that of the logarithm, so that U does not depend on the unit of depth, in units of EDGE_STEP.
    """
    edges = np.exp(-ALPHA * squared_log_gradient(depth) / EDGE_STEP**2)
    u = edges * np.power(np.clip(confidence, 0, 1), BETA) * theta**GAMMA
    return np.where(depth > 0, u, 0).astype(np.float32)


def squared_log_gradient(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) squared gradient of log depth per pixel; the larger of the two one-sided differences in each direction.

    Differences to pixels of unknown depth count as 0.
    """
    known = depth > 0
    log_depth = np.log(np.where(known, depth, 1))
    total = np.zeros(depth.shape, np.float64)
    for axis in (0, 1):
        step = np.abs(np.diff(log_depth, axis=axis))
        step *= np.logical_and(np.delete(known, 0, axis), np.delete(known, -1, axis))
        before = np.insert(step, 0, 0, axis=axis)
        after = np.insert(step, step.shape[axis], 0, axis=axis)
        total += np.maximum(before, after) ** 2
    return total.astype(np.float32)


def semantic_agreement(labels: NDArray[np.uint8], warped: NDArray[np.uint8]) -> float | None:
    """m_t: mean IoU over the classes of two (h, w) label images, where neither is void; None without such pixels."""
    if not ((labels != VOID) & (warped != VOID)).any():
        return None
    return float(mean_iou(labels, warped[None])[0])


def mean_iou(first: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(K,) of a label image (h, w) with others (K, h, w): the mean over the classes in either of intersection over
    union, where both are known; 0 when nothing is."""
    known = np.append(first[first != VOID], others[others != VOID])
    classes = int(known.max()) + 1 if len(known) else 1
    size = (classes + 1) ** 2
    mine = np.minimum(first, classes).ravel().astype(np.int64) * (classes + 1)
    out = [np.zeros(0)]
    for first_row in range(0, len(others), _BLOCK):
        block = np.minimum(others[first_row : first_row + _BLOCK], classes)
        place = np.arange(len(block))[:, None] * size + mine + block.reshape(len(block), -1)
        counts = np.bincount(place.ravel(), minlength=len(block) * size)
        both = counts.reshape(len(block), classes + 1, classes + 1)[:, :-1, :-1]
        shared = np.einsum("kcc->kc", both)
        union = both.sum(1) + both.sum(2) - shared
        out.append((shared / np.maximum(union, 1)).sum(1) / np.maximum((union > 0).sum(1), 1))
    return np.concatenate(out)


def theta(agreement: float) -> float:
    """MSGS-SLAM eq. (3): `1 / (1 + exp(-λ(m_t - φ)))`."""
    return float(1 / (1 + np.exp(-SLOPE * (agreement - MIDDLE))))


def warp_labels(
    labels: NDArray[np.uint8], other_from_cam: NDArray[np.float64], depth: NDArray[np.float32], intrinsics: Intrinsics
) -> NDArray[np.uint8]:
    """The other frame's labels as this frame sees them through its own depth; VOID where that leaves the image."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy, np.ones_like(x)], -1)
    points = (rays * depth[..., None]) @ other_from_cam[:3, :3].T + other_from_cam[:3, 3]
    z = np.where(points[..., 2] > 0, points[..., 2], np.inf)
    column = np.floor(intrinsics.fx * points[..., 0] / z + intrinsics.cx).astype(np.int64)
    row = np.floor(intrinsics.fy * points[..., 1] / z + intrinsics.cy).astype(np.int64)
    inside = (depth > 0) & np.isfinite(z) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, labels[np.where(inside, row, 0), np.where(inside, column, 0)], VOID).astype(np.uint8)
