"""Refinement of a depth map: small changes of inverse depth, judged by the correlation along the surface itself.

The sweep compares windows as if each lay on a plane that faces the camera. Here the windows follow the depth found so
far, so slanted surfaces correlate as well as frontal ones and the depth gets finer than the planes of the sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.stereo.bands import BAND_ROWS, Bands
from msgs_slam.pipelines.proxy.stereo.window import RADIUS, best_mean, correlate_row, warp_row, weigh_windows
from msgs_slam.pipelines.system.jit import kernel

_ALIKE = 1e3
"""Likeness by which all pixels of a window count alike: it lies on the surface itself, and needs all of its texture."""


def refine_inverse_depth(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    inverse_depth: NDArray[np.float32],
    step: float,
    reach: int,
    stiffness: float,
    best: int,
    bands: Bands,
) -> NDArray[np.float32]:
    """(H, W) inverse depth moved by up to `reach` steps to where the views correlate best.

    A move of n steps costs `stiffness` n² of correlation, so that a surface without texture stays where it is.
    """
    refined = np.empty_like(inverse_depth)

    def work(first: int, last: int) -> None:
        _refine_band(image, others, warps, inverse_depth, step, reach, stiffness, best, first, last, refined)

    bands.run(image.shape[0], work)
    return refined


@kernel
def _refine_band(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    inverse_depth: NDArray[np.float32],
    step: float,
    reach: int,
    stiffness: float,
    best: int,
    first: int,
    last: int,
    refined: NDArray[np.float32],
) -> None:
    height, width = image.shape
    views = others.shape[0]
    padded = width + 2 * RADIUS
    warped = np.empty((BAND_ROWS + 2 * RADIUS, padded), np.float32)
    seen = np.empty((BAND_ROWS + 2 * RADIUS, width), np.uint8)
    weights, weighted, moments = weigh_windows(image, first, last, _ALIKE)
    sums = np.empty((3, width), np.float32)
    scores = np.empty((BAND_ROWS, views, width), np.float32)
    total = np.empty((2 * reach + 1, BAND_ROWS, width), np.float32)
    for d in range(2 * reach + 1):
        for n in range(views):
            for k in range(last - first + 2 * RADIUS):
                y = min(max(first + k - RADIUS, 0), height - 1)
                warp_row(others[n], warps[n], inverse_depth[y], (d - reach) * step, y, warped[k], seen[k])
            for k in range(last - first):
                correlate_row(
                    warped[k:], weights[k], weighted[k], moments[k], seen[k + RADIUS], sums, scores[k, n]
                )  # fmt: skip
        for k in range(last - first):
            for x in range(width):
                total[d, k, x] = best_mean(scores[k], x, best) - np.float32(stiffness * (d - reach) ** 2)
    for k in range(last - first):
        for x in range(width):
            b = reach
            for d in range(2 * reach + 1):
                if total[d, k, x] > total[b, k, x]:
                    b = d
            offset = np.float32(b - reach)
            if 0 < b < 2 * reach:
                left, middle, right = total[b - 1, k, x], total[b, k, x], total[b + 1, k, x]
                bend = 2 * middle - left - right
                if bend > np.float32(1e-6):
                    offset += np.float32(0.5) * (right - left) / bend
            refined[first + k, x] = inverse_depth[first + k, x] + offset * np.float32(step)
