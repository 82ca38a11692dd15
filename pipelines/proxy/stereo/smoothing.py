"""Semi-global smoothing of a cost volume (Hirschmueller, PAMI 2008), eight directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.stereo.bands import Bands
from msgs_slam.pipelines.proxy.stereo.tiles import TILE, tiles_of
from msgs_slam.pipelines.system.jit import kernel

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


UNREACHED = np.float32(1e9)
"""Path cost of a plane that is not tried."""


def smooth_cost(
    cost: NDArray[np.float32],
    image: NDArray[np.float32],
    small: float,
    large: float,
    edge: float,
    bands: Bands,
    tried: NDArray[np.bool_] | None = None,
) -> NDArray[np.float32]:
    """(H, W, D) sum of the path costs, from the matching cost (H, W, D) and the reference image (H, W) in 0..1.

    A step of one plane costs `small`; a jump costs `large`, less where the intensity steps by about `edge` or more,
    and never less than `small`. Paths keep to the planes between the first and the last `tried` in each tile (as of
    `sweep_cost`): the others cost UNREACHED.
    """
    height, width, planes = cost.shape
    ranges = tried_ranges(tried, (height, width), planes)
    total = np.full_like(cost, UNREACHED)
    _begin(total, ranges)
    for dy, dx in DIRECTIONS:
        starts = path_starts(height, width, dy, dx)

        def work(first: int, last: int, dy: int = dy, dx: int = dx, starts: NDArray[np.int64] = starts) -> None:
            _scan_paths(cost, image, ranges, starts[first:last], dy, dx, small, large, edge, total)

        bands.run(len(starts), work, 64)
    return total


def tried_ranges(tried: NDArray[np.bool_] | None, size: tuple[int, int], planes: int) -> NDArray[np.int64]:
    """(tiles down, tiles across, 2) first plane tried in each tile of a picture of that size, and the one after the
    last."""
    if tried is None:
        return np.broadcast_to(np.array([0, planes]), (*tiles_of(*size), 2)).copy()
    return np.stack([tried.argmax(2), planes - tried[..., ::-1].argmax(2)], axis=-1)


def path_starts(height: int, width: int, dy: int, dx: int) -> NDArray[np.int64]:
    """(S, 2) row and column of the first pixel of every path of a direction; each pixel lies on exactly one path."""
    y, x = np.mgrid[:height, :width]
    before_y, before_x = y - dy, x - dx
    first = (before_y < 0) | (before_y >= height) | (before_x < 0) | (before_x >= width)
    return np.argwhere(first)


@kernel
def _begin(total: NDArray[np.float32], ranges: NDArray[np.int64]) -> None:
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            for d in range(ranges[y // TILE, x // TILE, 0], ranges[y // TILE, x // TILE, 1]):
                total[y, x, d] = 0


@kernel
def _scan_paths(
    cost: NDArray[np.float32],
    image: NDArray[np.float32],
    ranges: NDArray[np.int64],
    starts: NDArray[np.int64],
    dy: int,
    dx: int,
    small: float,
    large: float,
    edge: float,
    total: NDArray[np.float32],
) -> None:
    height, width, planes = cost.shape
    step = np.float32(small)
    far = UNREACHED
    # One cell of padding on both sides stands for "no such plane".
    before = np.empty(planes + 2, np.float32)
    now = np.empty(planes + 2, np.float32)
    before[0] = before[planes + 1] = now[0] = now[planes + 1] = far
    for s in range(len(starts)):
        y, x = starts[s, 0], starts[s, 1]
        lowest = np.float32(0)
        for d in range(planes + 2):
            before[d] = far
        first, last = ranges[y // TILE, x // TILE, 0], ranges[y // TILE, x // TILE, 1]
        for d in range(first, last):
            before[d + 1] = 0
        intensity = image[y, x]
        while 0 <= y < height and 0 <= x < width:
            change = abs(image[y, x] - intensity)
            intensity = image[y, x]
            jump = lowest + np.float32(max(large / (1 + change / edge), small))
            minimum = far
            low, high = ranges[y // TILE, x // TILE, 0], ranges[y // TILE, x // TILE, 1]
            # What lies there is of an earlier pixel.
            for d in range(low, min(high + 2, first + 1)):
                before[d] = far
            for d in range(max(last + 1, low), high + 2):
                before[d] = far
            for d in range(low, high):
                way = min(min(before[d + 1], jump), min(before[d], before[d + 2]) + step)
                value = cost[y, x, d] + way - lowest
                now[d + 1] = value
                total[y, x, d] += value
                minimum = min(minimum, value)
            lowest, first, last = minimum, low, high
            before, now = now, before
            y += dy
            x += dx


@kernel
def pick_planes(total: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) best plane as a fractional index: a parabola through the lowest sum and its two neighbours."""
    height, width, planes = total.shape
    index = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            k = 0
            for d in range(1, planes):
                if total[y, x, d] < total[y, x, k]:
                    k = d
            offset = np.float32(0)
            if 0 < k < planes - 1 and max(total[y, x, k - 1], total[y, x, k + 1]) < UNREACHED:
                a, b, c = total[y, x, k - 1], total[y, x, k], total[y, x, k + 1]
                bend = a + c - 2 * b
                if bend > 0:
                    offset = min(max((a - c) / (2 * bend), np.float32(-0.5)), np.float32(0.5))
            index[y, x] = np.float32(k) + offset
    return index
