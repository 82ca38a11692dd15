"""The window by which two views are compared: pixels count by how like the middle they are.

A plain square that reaches over the border of an object is matched by that border, so the object grows by half a
window into whatever lies behind it. With weights by colour (Yoon and Kweon, PAMI 2006) a pixel is compared by its own
surface. The weights fall off as a Gaussian and not as an exponential: the contrast of a border is so much larger than
the texture of a wall that a thousandth of the weight still decides the correlation.

No kernel that correlates is compiled with fastmath: machine code made in the process and the same taken from the cache
were seen to round differently with it, and a run has to end with the same bytes either way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.system.jit import kernel

RADIUS = 3
STEP = 2
SIDE = 4
"""Every second pixel of 7 x 7, from -RADIUS to RADIUS: as good as all of them, at a third of the time."""
LIKENESS = 0.04
"""How unlike a pixel may be and still count, of intensities 0..1: more than the texture of most surfaces, less than the
step from one to the next."""
VARIANCE_FLOOR = 2e-5
"""Added to both variances (intensities 0..1): below about one grey level there is no texture, only noise."""
OUTSIDE = -2.0
"""Marks the score of a view that does not see the pixel."""


@kernel
def weigh_windows(
    image: NDArray[np.float32], first: int, last: int, likeness: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Of rows first..last of the image (H, W): the windows' weights and the weights times intensity, both
    (rows, SIDE, SIDE, W) with sums of one window 1 and its mean; and mean and variance (rows, 2, W).

    likeness: standard deviation of the weights, a difference in intensity. The border is repeated outwards.
    """
    height, width = image.shape
    weights = np.empty((last - first, SIDE, SIDE, width), np.float32)
    weighted = np.empty((last - first, SIDE, SIDE, width), np.float32)
    moments = np.empty((last - first, 2, width), np.float32)
    narrow = np.float32(-0.5 / likeness**2)
    for k in range(last - first):
        for x in range(width):
            middle = image[first + k, x]
            total = np.float32(0)
            mean = np.float32(0)
            square = np.float32(0)
            for j in range(SIDE):
                row = min(max(first + k + j * STEP - RADIUS, 0), height - 1)
                for i in range(SIDE):
                    value = image[row, min(max(x + i * STEP - RADIUS, 0), width - 1)]
                    # The middle is no part of the window; the floor keeps a lone bright pixel from dividing by nothing.
                    weight = np.exp(narrow * (value - middle) ** 2) + np.float32(1e-6)
                    total += weight
                    mean += weight * value
                    square += weight * value * value
                    weights[k, j, i, x] = weight
                    weighted[k, j, i, x] = weight * value
            share = np.float32(1) / total
            for j in range(SIDE):
                for i in range(SIDE):
                    weights[k, j, i, x] *= share
                    weighted[k, j, i, x] *= share
            mean *= share
            moments[k, 0, x] = mean
            moments[k, 1, x] = max(square * share - mean * mean, np.float32(0))
    return weights, weighted, moments


@kernel
def warp_row(
    other: NDArray[np.float32],
    warp: NDArray[np.float64],
    inverse_depths: NDArray[np.float32],
    offset: float,
    y: int,
    row: NDArray[np.float32],
    seen: NDArray[np.uint8],
) -> None:
    """Into `row` samples of `other` for row y of the reference, its pixels of inverse depths (W,) plus `offset`, the
    border repeated; into `seen` (W,) whether they lie in the other view."""
    rows, columns = other.shape
    width = len(inverse_depths)
    v = y + 0.5
    bx = np.float32(warp[0, 1] * v + warp[0, 2])
    by = np.float32(warp[1, 1] * v + warp[1, 2])
    bz = np.float32(warp[2, 1] * v + warp[2, 2])
    ax, ay, az = np.float32(warp[0, 0]), np.float32(warp[1, 0]), np.float32(warp[2, 0])
    tx, ty, tz = np.float32(warp[0, 3]), np.float32(warp[1, 3]), np.float32(warp[2, 3])
    right, bottom, half = np.float32(columns - 1.001), np.float32(rows - 1.001), np.float32(0.5)
    for x in range(width):
        w = inverse_depths[x] + np.float32(offset)
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
def correlate_row(
    warped: NDArray[np.float32],
    weights: NDArray[np.float32],
    weighted: NDArray[np.float32],
    moments: NDArray[np.float32],
    seen: NDArray[np.uint8],
    sums: NDArray[np.float32],
    score: NDArray[np.float32],
) -> None:
    """Into `score` (W,) the weighted correlation of one row's windows with the samples `warped` (2 RADIUS + 1,
    W + 2 RADIUS) of another view; OUTSIDE where `seen` is 0 or a sample is NaN. `sums` (3, W) is room to work in."""
    width = len(score)
    sums[:] = 0
    for j in range(SIDE):
        for i in range(SIDE):
            for x in range(width):
                value = warped[j * STEP, i * STEP + x]
                part = weights[j, i, x] * value
                sums[0, x] += part
                sums[1, x] += part * value
                sums[2, x] += weighted[j, i, x] * value
    floor = np.float32(VARIANCE_FLOOR)
    for x in range(width):
        mean = sums[0, x]
        variance = max(sums[1, x] - mean * mean, np.float32(0))
        covariance = sums[2, x] - mean * moments[0, x]
        value = covariance / np.sqrt((variance + floor) * (moments[1, x] + floor))
        # Samples of what is no scene are NaN, and so is what is made of them.
        score[x] = value if seen[x] and value == value else np.float32(OUTSIDE)


@kernel
def best_mean(scores: NDArray[np.float32], x: int, best: int) -> np.floating:
    """Mean of the `best` largest scores of column x among the views that see it; 0 when none does. Alters `scores`."""
    total = np.float32(0)
    used = 0
    for _ in range(best):
        at = 0
        for n in range(1, scores.shape[0]):
            if scores[n, x] > scores[at, x]:
                at = n
        if scores[at, x] <= np.float32(OUTSIDE):
            break
        total += scores[at, x]
        scores[at, x] = np.float32(OUTSIDE)
        used += 1
    return total / np.float32(max(used, 1))
