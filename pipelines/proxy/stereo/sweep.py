"""Plane sweep: how well each inverse depth of a pixel agrees with the neighbouring views.

The score of a hypothesis is the zero-mean normalised cross-correlation of a weighted window, averaged over the best few
neighbours, so that an occlusion in the others does not count (Kang, Szeliski, Chai, CVPR 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.jit import kernel
from pipelines.proxy.stereo.bands import BAND_ROWS, Bands
from pipelines.proxy.stereo.window import RADIUS, best_mean, correlate_row, weigh_windows

LIKENESS = 0.04
"""How unlike a pixel may be and still count, of intensities 0..1: more than the texture of most surfaces, less than the
step from one to the next."""


def warps_to(
    matrix: NDArray[np.float64],
    cam_from_world: NDArray[np.float64],
    matrices: list[NDArray[np.float64]],
    cams_from_world: list[NDArray[np.float64]],
) -> NDArray[np.float64]:
    """(N, 3, 4): pixel (x, y) of inverse depth w lies at `warp @ (x, y, 1, w)` of the other view, homogeneous."""
    inverse = np.linalg.inv(matrix)
    warps = []
    for other, other_from_world in zip(matrices, cams_from_world, strict=True):
        other_from_cam = other_from_world @ np.linalg.inv(cam_from_world)
        warps.append(np.column_stack([other @ other_from_cam[:3, :3] @ inverse, other @ other_from_cam[:3, 3]]))
    return np.array(warps)


def sweep_cost(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    inverse_depths: NDArray[np.float64],
    best: int,
    bands: Bands,
) -> NDArray[np.float32]:
    """(H, W, D) cost 1 - score in [0, 2] of every inverse depth; `others` (N, H, W) lie as the warps say.

    Intensities are 0..1. Where no view sees the point the cost is 1, as for a surface without texture.
    """
    height, width = image.shape
    cost = np.empty((height, width, len(inverse_depths)), np.float32)

    def work(first: int, last: int) -> None:
        _sweep_band(image, others, warps, inverse_depths, best, first, last, cost)

    bands.run(height, work)
    return cost


@kernel
def _warp_row(
    other: NDArray[np.float32],
    warp: NDArray[np.float64],
    inverse_depth: float,
    y: int,
    width: int,
    row: NDArray[np.float32],
    seen: NDArray[np.uint8],
) -> None:
    """Samples of `other` for one row of the reference on a plane of constant inverse depth; the border is repeated."""
    rows, columns = other.shape
    v = y + 0.5
    bx = np.float32(warp[0, 1] * v + warp[0, 2] + warp[0, 3] * inverse_depth)
    by = np.float32(warp[1, 1] * v + warp[1, 2] + warp[1, 3] * inverse_depth)
    bz = np.float32(warp[2, 1] * v + warp[2, 2] + warp[2, 3] * inverse_depth)
    ax = np.float32(warp[0, 0])
    ay = np.float32(warp[1, 0])
    az = np.float32(warp[2, 0])
    right = np.float32(columns - 1.001)
    bottom = np.float32(rows - 1.001)
    half = np.float32(0.5)
    for x in range(width):
        u = np.float32(x) + half
        z = az * u + bz
        scale = np.float32(1) / max(z, np.float32(1e-6))
        px = (ax * u + bx) * scale - half
        py = (ay * u + by) * scale - half
        seen[x] = (z > np.float32(1e-6)) & (px >= -half) & (py >= -half) & (px <= right + half) & (py <= bottom + half)
        px = min(max(px, np.float32(0)), right)
        py = min(max(py, np.float32(0)), bottom)
        ix = np.int32(px)
        iy = np.int32(py)
        fx = px - np.float32(ix)
        fy = py - np.float32(iy)
        top = other[iy, ix] + fx * (other[iy, ix + 1] - other[iy, ix])
        low = other[iy + 1, ix] + fx * (other[iy + 1, ix + 1] - other[iy + 1, ix])
        row[x + RADIUS] = top + fy * (low - top)
    for i in range(RADIUS):
        row[i] = row[RADIUS]
        row[width + RADIUS + i] = row[width + RADIUS - 1]


@kernel
def _sweep_band(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    inverse_depths: NDArray[np.float64],
    best: int,
    first: int,
    last: int,
    cost: NDArray[np.float32],
) -> None:
    height, width = image.shape
    views = others.shape[0]
    padded = width + 2 * RADIUS
    warped = np.empty((BAND_ROWS + 2 * RADIUS, padded), np.float32)
    seen = np.empty((BAND_ROWS + 2 * RADIUS, width), np.uint8)
    weights, weighted, moments = weigh_windows(image, first, last, LIKENESS)
    sums = np.empty((3, width), np.float32)
    scores = np.empty((BAND_ROWS, views, width), np.float32)
    block = np.empty((len(inverse_depths), last - first, width), np.float32)
    for d in range(len(inverse_depths)):
        for n in range(views):
            for k in range(last - first + 2 * RADIUS):
                y = min(max(first + k - RADIUS, 0), height - 1)
                _warp_row(others[n], warps[n], inverse_depths[d], y, width, warped[k], seen[k])
            for k in range(last - first):
                correlate_row(
                    warped[k:], weights[k], weighted[k], moments[k], seen[k + RADIUS], sums, scores[k, n]
                )  # fmt: skip
        for k in range(last - first):
            for x in range(width):
                block[d, k, x] = np.float32(1) - best_mean(scores[k], x, best)
    # Turned round in one go: writing plane by plane into (H, W, D) would miss the cache at every pixel.
    for k in range(last - first):
        for x in range(width):
            for d in range(len(inverse_depths)):
                cost[first + k, x, d] = block[d, k, x]
