"""Semi-global smoothing of a cost volume (Hirschmueller, PAMI 2008), eight directions."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...compute.lanes import load, splat, store
from ...compute.threads import fused_kernel, inner
from .lane_sampling import smallest, smallest_of
from .volume import BLOCK, TILE, UNREACHED, Bands, Volume, pixel_of_tile

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))

_ABREAST = 16
"""Paths that are walked side by side: a step waits for the one before it on the same path, but not for another's."""


def smooth_cost(
    cost: Volume, image: NDArray[np.float32], small: float, large: float, edge: float, bands: Bands
) -> Volume:
    """The sum of the path costs, from the matching cost and the reference image (H, W) in 0..1.

    A step of one plane costs `small`; a jump costs `large`, less where the intensity steps by about `edge` or more,
    and never less than `small`. Paths keep to the planes that are tried.
    """
    total = cost.zeros()
    for dy, dx in DIRECTIONS:
        starts = path_starts(cost.height, cost.width, dy, dx)

        def work(first: int, last: int, dy: int = dy, dx: int = dx, starts: NDArray[np.int64] = starts) -> None:
            _scan_paths(
                cost.values, cost.places, cost.strides, image, starts[first:last], dy, dx, small, large, edge,
                total.values,
            )  # fmt: skip

        bands.run(len(starts), work, 64)
    return total


@lru_cache(maxsize=2 * len(DIRECTIONS))
def path_starts(height: int, width: int, dy: int, dx: int) -> NDArray[np.int64]:
    """(S, 2) row and column of the first pixel of every path of a direction; each pixel lies on exactly one path."""
    y, x = np.mgrid[:height, :width]
    before_y, before_x = y - dy, x - dx
    first = (before_y < 0) | (before_y >= height) | (before_x < 0) | (before_x >= width)
    return np.argwhere(first)


@fused_kernel
def _scan_paths(
    cost: NDArray[np.float32],
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    image: NDArray[np.float32],
    starts: NDArray[np.int64],
    dy: int,
    dx: int,
    small: float,
    large: float,
    edge: float,
    total: NDArray[np.float32],
) -> None:
    height, width = image.shape
    planes, step, far = places.shape[2] * BLOCK, splat(np.float32(small)), splat(UNREACHED)
    # One cell of padding on both sides stands for "no such plane"; so do the planes of blocks that a tile has not.
    before, now = np.empty((_ABREAST, planes + 2), np.float32), np.empty((_ABREAST, planes + 2), np.float32)
    lowest, intensity = np.empty(_ABREAST, np.float32), np.empty(_ABREAST, np.float32)
    stale = np.empty(_ABREAST, np.int64)
    for group in range(0, len(starts), _ABREAST):
        count, steps = min(_ABREAST, len(starts) - group), 0
        for s in range(count):
            y, x = starts[group + s, 0], starts[group + s, 1]
            lowest[s], intensity[s], stale[s] = 0, image[y, x], 2
            _begin(places[y // TILE, x // TILE], before[s])
        alive = True
        while alive:
            alive = False
            for s in range(count):
                y, x = starts[group + s, 0] + steps * dy, starts[group + s, 1] + steps * dx
                if y < 0 or y >= height or x < 0 or x >= width:
                    continue
                alive = True
                change = abs(image[y, x] - intensity[s])
                intensity[s] = image[y, x]
                jump = splat(lowest[s] + np.float32(max(large / (1 + change / edge), small)))
                tile_y, tile_x = y // TILE, x // TILE
                pixel = pixel_of_tile(y, x) * strides[tile_y, tile_x]
                old, new = before[s], now[s]
                # They hold what is not known here of the tile that the path has left.
                if stale[s] > 0:
                    new[:] = UNREACHED
                    stale[s] -= 1
                minimum, base = far, splat(lowest[s])
                for b in range(places.shape[2]):
                    if places[tile_y, tile_x, b] < 0:
                        continue
                    place, d = places[tile_y, tile_x, b] + pixel, b * BLOCK
                    way = smallest(smallest(load(old, d), load(old, d + 2)) + step, load(old, d + 1))
                    value = load(cost, place) + (smallest(way, jump) - base)
                    store(new, d + 1, value)
                    store(total, place, load(total, place) + value)
                    minimum = smallest(minimum, value)
                lowest[s] = smallest_of(minimum)
                if (y + dy) // TILE != tile_y or (x + dx) // TILE != tile_x:
                    stale[s] = 2
            before, now = now, before
            steps += 1


@inner
def _begin(here: NDArray[np.int64], before: NDArray[np.float32]) -> None:
    """A path's first pixel has no way to it: 0 in the blocks of its tile."""
    before[:] = UNREACHED
    for b in range(len(here)):
        if here[b] >= 0:
            before[b * BLOCK + 1 : (b + 1) * BLOCK + 1] = 0
