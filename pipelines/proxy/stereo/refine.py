"""Refinement of a depth map: small changes of inverse depth, judged by the correlation along the surface itself.

The sweep compares windows as if each lay on a plane that faces the camera. Here the windows follow the depth found so
far, so slanted surfaces correlate as well as frontal ones and the depth gets finer than the planes of the sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.jit import kernel
from pipelines.proxy.stereo.bands import BAND_ROWS, Bands
from pipelines.proxy.stereo.window import RADIUS, best_mean, correlate_row, weigh_windows

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
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(H, W) inverse depth moved by up to `reach` steps to where the views correlate best, and that correlation.

    A move of n steps costs `stiffness` n² of correlation, so that a surface without texture stays where it is.
    """
    refined = np.empty_like(inverse_depth)
    score = np.empty_like(inverse_depth)

    def work(first: int, last: int) -> None:
        _refine_band(
            image,
            others,
            warps,
            inverse_depth,
            step,
            reach,
            stiffness,
            best,
            first,
            last,
            refined,
            score,
        )

    bands.run(image.shape[0], work)
    return refined, score


@kernel
def _warp_surface_row(
    other: NDArray[np.float32],
    warp: NDArray[np.float64],
    inverse_depth: NDArray[np.float32],
    offset: float,
    y: int,
    row: NDArray[np.float32],
    seen: NDArray[np.uint8],
) -> None:
    rows, columns = other.shape
    width = inverse_depth.shape[1]
    v = y + 0.5
    bx = np.float32(warp[0, 1] * v + warp[0, 2])
    by = np.float32(warp[1, 1] * v + warp[1, 2])
    bz = np.float32(warp[2, 1] * v + warp[2, 2])
    ax, ay, az = np.float32(warp[0, 0]), np.float32(warp[1, 0]), np.float32(warp[2, 0])
    tx, ty, tz = np.float32(warp[0, 3]), np.float32(warp[1, 3]), np.float32(warp[2, 3])
    right, bottom, half = np.float32(columns - 1.001), np.float32(rows - 1.001), np.float32(0.5)
    for x in range(width):
        w = inverse_depth[y, x] + np.float32(offset)
        u = np.float32(x) + half
        z = az * u + bz + tz * w
        scale = np.float32(1) / max(z, np.float32(1e-6))
        px = (ax * u + bx + tx * w) * scale - half
        py = (ay * u + by + ty * w) * scale - half
        seen[x] = (z > np.float32(1e-6)) & (px >= -half) & (py >= -half) & (px <= right + half) & (py <= bottom + half)
        px = min(max(px, np.float32(0)), right)
        py = min(max(py, np.float32(0)), bottom)
        ix, iy = np.int32(px), np.int32(py)
        fx, fy = px - np.float32(ix), py - np.float32(iy)
        top = other[iy, ix] + fx * (other[iy, ix + 1] - other[iy, ix])
        low = other[iy + 1, ix] + fx * (other[iy + 1, ix + 1] - other[iy + 1, ix])
        row[x + RADIUS] = top + fy * (low - top)
    for i in range(RADIUS):
        row[i] = row[RADIUS]
        row[width + RADIUS + i] = row[width + RADIUS - 1]


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
    score: NDArray[np.float32],
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
                _warp_surface_row(others[n], warps[n], inverse_depth, (d - reach) * step, y, warped[k], seen[k])
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
            score[first + k, x] = total[b, k, x] + np.float32(stiffness * (b - reach) ** 2)
