"""Depth where the views do not agree: planes through regions of one colour, else what lies along like colours.

Walls and cupboards without texture cannot be matched, but their borders can, and they are mostly flat.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.graph_cut import cut_image
from msgs_slam.pipelines.proxy.regions.spread import spread_votes

SURE = 0.3
"""Confidence from which a depth is evidence and stays as it is."""
_PLANE_CONFIDENCE, _SPREAD_CONFIDENCE, _GUESS_CONFIDENCE = 0.2, 0.1, 0.03
_REGION_SCALE = 250.0
_LEAST_PIXELS = 40
_RESIDUAL = 0.015
_REACH, _COLOR_SD = 40.0, 30.0


def fill_unsure(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], image: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) depth and confidence with every unsure depth replaced by a guess of low confidence; image (h, w, 3)."""
    sure = (confidence >= SURE) & (depth > 0)
    if sure.sum() < _LEAST_PIXELS:
        return depth, np.minimum(confidence, SURE)
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    low, high = np.quantile(inverse[sure], [0.002, 0.998])
    weight = np.where(sure, confidence, 0).astype(np.float64)
    spread, reached = _along_colors(inverse, weight, image)
    plane, fit = _planes(inverse, weight, cut_image(image, _REGION_SCALE))
    flat = ~sure & (fit > 0.5) & (plane > 0.7 * low) & (plane < 1.3 * high)
    near = ~sure & ~flat & (reached > 1e-4)
    guess = np.where(flat, plane, np.where(near, spread, inverse))
    filled = np.where(sure, depth, np.divide(1.0, guess, out=np.zeros(depth.shape), where=guess > 0))
    trust = np.where(flat, _PLANE_CONFIDENCE * fit, np.where(near, _SPREAD_CONFIDENCE, _GUESS_CONFIDENCE))
    return filled.astype(np.float32), np.where(sure, confidence, trust * (filled > 0)).astype(np.float32)


def _along_colors(
    inverse: NDArray[np.float64], weight: NDArray[np.float64], image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    votes = np.stack([weight, weight * inverse], axis=-1).astype(np.float32)
    votes = spread_votes(votes, image, _REACH, _COLOR_SD).astype(np.float64)
    return np.asarray(votes[..., 1] / np.maximum(votes[..., 0], 1e-12), np.float64), np.asarray(
        votes[..., 0], np.float64
    )


def _planes(
    inverse: NDArray[np.float64], weight: NDArray[np.float64], region: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(h, w) inverse depth of the plane through each region's evidence (in a picture, the inverse depth of a plane
    is linear), and the share of the evidence that lies on it; 0 for a region with too little evidence."""
    height, width = inverse.shape
    count = int(region.max()) + 1
    flat = region.ravel()
    used = np.flatnonzero(weight.ravel() > 0)
    group, value, base = flat[used], inverse.ravel()[used], weight.ravel()[used]
    y, x = np.divmod(np.arange(height * width), width)
    mass = np.maximum(np.bincount(group, base, count), 1e-12)
    center_x = np.bincount(group, base * x[used], count) / mass
    center_y = np.bincount(group, base * y[used], count) / mass
    design = np.stack([(x - center_x[flat]) / width, (y - center_y[flat]) / width, np.ones(height * width)], -1)
    rows = design[used]
    scale = np.maximum(np.bincount(group, base * value, count) / mass, 1e-12) * _RESIDUAL
    robust = np.ones(len(used))
    for _ in range(8):
        solution = _solve(rows, value, base * robust, group, count)
        residual = (value - (rows * solution[group]).sum(-1)) / scale[group]
        robust = 1 / (1 + residual**2) ** 2
    share = np.bincount(group, base * (np.abs(residual) < 2), count) / mass
    enough = np.bincount(group, minlength=count) >= _LEAST_PIXELS
    return (design * solution[flat]).sum(-1).reshape(region.shape), (share * enough)[flat].reshape(region.shape)


def _solve(
    rows: NDArray[np.float64],
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    group: NDArray[np.int64],
    count: int,
) -> NDArray[np.float64]:
    """(G, 3) weighted least squares of every group; slopes that the evidence does not fix are kept small."""
    normal = np.empty((count, 3, 3))
    right = np.empty((count, 3))
    for i in range(3):
        right[:, i] = np.bincount(group, weight * rows[:, i] * value, count)
        for j in range(3):
            normal[:, i, j] = np.bincount(group, weight * rows[:, i] * rows[:, j], count)
    normal += np.diag([1e-3, 1e-3, 1e-9]) * (normal[:, 2, 2][:, None, None] + 1e-9)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
