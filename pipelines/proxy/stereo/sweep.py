"""Plane sweep: how well each inverse depth of a pixel agrees with the neighbouring views.

The score of a hypothesis is the zero-mean normalised cross-correlation of a weighted window, averaged over the best few
neighbours, so that an occlusion in the others does not count (Kang, Szeliski, Chai, CVPR 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.stereo.bands import BAND_ROWS, Bands
from msgs_slam.pipelines.proxy.stereo.window import LIKENESS, RADIUS, best_mean, correlate_row, warp_row, weigh_windows
from msgs_slam.pipelines.system.jit import kernel


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
    plane = np.zeros(width, np.float32)
    weights, weighted, moments = weigh_windows(image, first, last, LIKENESS)
    sums = np.empty((3, width), np.float32)
    scores = np.empty((BAND_ROWS, views, width), np.float32)
    block = np.empty((len(inverse_depths), last - first, width), np.float32)
    for d in range(len(inverse_depths)):
        for n in range(views):
            for k in range(last - first + 2 * RADIUS):
                y = min(max(first + k - RADIUS, 0), height - 1)
                warp_row(others[n], warps[n], plane, inverse_depths[d], y, warped[k], seen[k])
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
