"""Bands of rows on threads, and the numbers of a pixel's planes: costs of a match, and their sums along paths.

The bytes are the same whatever the number of threads. Of a volume there is only what is tried: planes in a tile.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel
from ...system.lanes import load, splat, store
from ...system.threads import fused_kernel, inner
from .lane_sampling import smallest, smallest_of

TILE = BAND_ROWS = 16
"""Pixels of a tile across and down: the rows of a band, and the pixels that one vector holds."""
BLOCK = 16
"""Planes of a block, as many as a vector holds."""
UNREACHED = np.float32(1e9)
"""Cost of a plane that is not tried."""


class Bands:
    """Runs kernels that release the interpreter lock over bands of rows; every band writes only its own rows."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def run(self, count: int, work: Callable[[int, int], object], size: int = BAND_ROWS) -> None:
        """Call `work(first, last)` for consecutive bands of 0..count. The bands do not depend on the threads."""
        starts = range(0, count, size)
        if self._pool is None:
            for start in starts:
                work(start, min(start + size, count))
            return
        for future in [self._pool.submit(work, s, min(s + size, count)) for s in starts]:
            future.result()

    def close(self) -> None:
        """Wait for the threads to end."""
        if self._pool is not None:
            self._pool.shutdown()


def tiles_of(height: int, width: int) -> tuple[int, int]:
    """Return how many tiles an image of that size has down and across."""
    return -(-height // TILE), -(-width // TILE)


class CostVolume(NamedTuple):
    """Numbers of the planes that are tried in an image (height, width).

    Each tile has the blocks of planes in which any is tried, pixel after pixel in flat `values` (float32), `strides`
    (tiles down, tiles across) apart. `places` (tiles down, tiles across, blocks): where its first pixel's numbers of
    each block begin, -1 where the tile has none. A plane of a block that is not tried has UNREACHED.
    """

    height: int
    width: int
    planes: int
    values: NDArray[np.float32]
    places: NDArray[np.int64]
    strides: NDArray[np.int64]

    @staticmethod
    def of_tried(height: int, width: int, tried: NDArray[np.bool_]) -> CostVolume:
        """Room for the planes `tried` (tiles down, tiles across, D); its values are anything."""
        planes = tried.shape[2]
        filled = np.pad(tried, ((0, 0), (0, 0), (0, -planes % BLOCK)))
        there = filled.reshape(*tried.shape[:2], -1, BLOCK).any(3)
        strides = BLOCK * there.sum(2)
        ends = TILE * TILE * strides.cumsum().reshape(strides.shape)
        firsts = (ends - TILE * TILE * strides)[..., None] + BLOCK * (there.cumsum(2) - 1)
        return CostVolume(
            height, width, planes, np.empty(ends[-1, -1], np.float32), np.where(there, firsts, -1), strides
        )

    def zeros(self) -> CostVolume:
        """Another of the same shape, of zeros."""
        return self._replace(values=np.zeros_like(self.values))


@inner(makes_arrays=False)
def pixel_of_tile(y: int, x: int) -> int:
    """Return the number of a pixel in its tile."""
    return y % TILE * TILE + x % TILE


def least_planes(volume: CostVolume) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(H, W) plane of least cost, the first of those, and its cost."""
    shape = (volume.height, volume.width)
    index, least = np.empty(shape, np.int64), np.empty(shape, np.float32)
    _find_least(volume.values, volume.places, volume.strides, index, least)
    return index, least


@kernel
def _find_least(
    values: NDArray[np.float32],
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    index: NDArray[np.int64],
    least: NDArray[np.float32],
) -> None:
    height, width = index.shape
    for y in range(height):
        for x in range(width):
            pixel = pixel_of_tile(y, x) * strides[y // TILE, x // TILE]
            best, lowest = 0, np.float32(np.inf)
            for b in range(places.shape[2]):
                place = places[y // TILE, x // TILE, b] + pixel
                if place < pixel:
                    continue
                for d in range(BLOCK):
                    if values[place + d] < lowest:
                        best, lowest = b * BLOCK + d, values[place + d]
            index[y, x], least[y, x] = best, lowest


def pick_planes(volume: CostVolume) -> NDArray[np.float32]:
    """(H, W) best plane as a fractional index: a parabola through the lowest number and its two neighbours."""
    index, least = least_planes(volume)
    fractional = np.empty(index.shape, np.float32)
    _pick(volume.values, volume.places, volume.strides, index, least, fractional)
    return fractional


@kernel
def _pick(
    values: NDArray[np.float32],
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    index: NDArray[np.int64],
    least: NDArray[np.float32],
    fractional: NDArray[np.float32],
) -> None:
    height, width = index.shape
    for y in range(height):
        for x in range(width):
            pixel, here = pixel_of_tile(y, x) * strides[y // TILE, x // TILE], places[y // TILE, x // TILE]
            before, after = index[y, x] - 1, index[y, x] + 1
            offset = np.float32(0)
            known = before >= 0 and after < BLOCK * len(here)
            if known and here[before // BLOCK] >= 0 and here[after // BLOCK] >= 0:
                a = values[here[before // BLOCK] + pixel + before % BLOCK]
                c = values[here[after // BLOCK] + pixel + after % BLOCK]
                bend = a + c - 2 * least[y, x]
                if bend > 0 and max(a, c) < UNREACHED:
                    offset = min(max((a - c) / (2 * bend), np.float32(-0.5)), np.float32(0.5))
            fractional[y, x] = np.float32(index[y, x]) + offset


DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))

_ABREAST = 16
"""Paths that are walked side by side: a step waits for the one before it on the same path, but not for another's."""


def smooth_cost(
    cost: CostVolume, image: NDArray[np.float32], small: float, large: float, edge: float, bands: Bands
) -> CostVolume:
    """The sum of the path costs, from the matching cost and the reference image (H, W) in 0..1.

    A step of one plane costs `small`; a jump costs `large`, less where the intensity steps by about `edge` or more,
    and never less than `small`. Paths keep to the planes that are tried.
    """
    total = cost.zeros()
    for dy, dx in DIRECTIONS:
        starts = path_starts(cost.height, cost.width, dy, dx)

        def work(first: int, last: int, dy: int = dy, dx: int = dx, starts: NDArray[np.int64] = starts) -> None:
            planes = cost.places.shape[2] * BLOCK
            # One cell of padding on both sides stands for "no such plane"; so do the planes of blocks a tile has not.
            kept = np.empty((2, _ABREAST, planes + 2), np.float32), np.empty((2, _ABREAST), np.float32)
            _scan_paths(
                cost.values, cost.places, cost.strides, image, starts[first:last], dy, dx, small, large, edge,
                total.values, *kept, np.empty(_ABREAST, np.int64),
            )  # fmt: skip

        bands.run(len(starts), work, 64)
    return total


@lru_cache(maxsize=4 * len(DIRECTIONS))
def path_starts(height: int, width: int, dy: int, dx: int) -> NDArray[np.int64]:
    """(S, 2) row and column of the first pixel of every path of a direction; each pixel lies on exactly one path."""
    y, x = np.mgrid[:height, :width]
    before_y, before_x = y - dy, x - dx
    first = (before_y < 0) | (before_y >= height) | (before_x < 0) | (before_x >= width)
    return np.argwhere(first)


@fused_kernel(makes_arrays=False)
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
    sums: NDArray[np.float32],
    ends: NDArray[np.float32],
    stale: NDArray[np.int64],
) -> None:
    """Walk along the paths from their `starts`; sums (2, paths abreast, D + 2) before and now, ends (2, paths abreast)
    the least of them and the intensity, and `stale` (paths abreast,) are what each of them keeps."""
    height, width = image.shape
    step, far = splat(np.float32(small)), splat(UNREACHED)
    before, now, lowest, intensity = sums[0], sums[1], ends[0], ends[1]
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


@inner(makes_arrays=False)
def _begin(here: NDArray[np.int64], before: NDArray[np.float32]) -> None:
    """A path's first pixel has no way to it: 0 in the blocks of its tile."""
    before[:] = UNREACHED
    for b in range(len(here)):
        if here[b] >= 0:
            before[b * BLOCK + 1 : (b + 1) * BLOCK + 1] = 0
