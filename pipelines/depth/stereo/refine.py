"""Refinement of a depth map: small changes of inverse depth, judged by the correlation along the surface itself.

The sweep compares windows as if each lay on a plane that faces the camera. Here the windows follow the depth found so
far, so slanted surfaces correlate as well as frontal ones and the depth gets finer than the planes of the sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compute.jit import kernel
from ...compute.lanes import store
from .bands import Bands
from .lane_sampling import with_row_below
from .tiles import TILE
from .window import RADIUS, SAMPLED_ROWS, best_mean, pad_rows, row_length, warp_row, weigh_windows

ALIKE = 1e3
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
    refined, paired = np.empty_like(inverse_depth), with_row_below(others)

    def work(first: int, last: int) -> None:
        _refine_band(image, paired, warps, inverse_depth, step, reach, stiffness, best, first, last, refined)

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
    views, rows, columns, _ = others.shape
    length = row_length(width)
    samples = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    seen = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    needed = np.ones(length // TILE, np.bool_)
    surface, top = np.zeros(length, np.float32), np.empty(16 * best, np.float32)
    reference = pad_rows(image, first, last)
    weights, moments = weigh_windows(reference, length, ALIKE)
    total = np.empty((2 * reach + 1, last - first, length), np.float32)
    for d in range(2 * reach + 1):
        for k in range(last - first + 2 * RADIUS):
            y = min(max(first + k - RADIUS, 0), height - 1)
            for x in range(length):
                surface[x] = inverse_depth[y, min(max(x - RADIUS, 0), width - 1)]
            for n in range(views):
                warp_row(
                    others[n].reshape(-1), columns, rows, warps[n], surface, (d - reach) * step, y, width, needed,
                    samples, seen, (n * SAMPLED_ROWS + k) * length,
                )  # fmt: skip
        penalty = np.float32(stiffness * (d - reach) ** 2)
        for k in range(last - first):
            for x in range(0, width, TILE):
                score = best_mean(samples, seen, weights, reference, moments, length, views, k, x, top)
                store(total[d, k], x, score - penalty)
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
