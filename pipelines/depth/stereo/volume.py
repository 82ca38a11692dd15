"""Bands of rows on threads, and the numbers of a pixel's planes: costs of a match, and their sums along paths.

The bytes are the same whatever the number of threads. Of a volume there is only what is tried: planes in a tile.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compute.threads import inner
from ...system.jit import kernel

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


class Volume(NamedTuple):
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
    def of_tried(height: int, width: int, tried: NDArray[np.bool_]) -> Volume:
        """Room for the planes `tried` (tiles down, tiles across, D); its values are anything."""
        planes = tried.shape[2]
        filled = np.pad(tried, ((0, 0), (0, 0), (0, -planes % BLOCK)))
        there = filled.reshape(*tried.shape[:2], -1, BLOCK).any(3)
        strides = BLOCK * there.sum(2)
        ends = TILE * TILE * strides.cumsum().reshape(strides.shape)
        firsts = (ends - TILE * TILE * strides)[..., None] + BLOCK * (there.cumsum(2) - 1)
        return Volume(height, width, planes, np.empty(ends[-1, -1], np.float32), np.where(there, firsts, -1), strides)

    def zeros(self) -> Volume:
        """Another of the same shape, of zeros."""
        return self._replace(values=np.zeros_like(self.values))


@inner
def pixel_of_tile(y: int, x: int) -> int:
    """Return the number of a pixel in its tile."""
    return y % TILE * TILE + x % TILE


def least_planes(volume: Volume) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
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


def pick_planes(volume: Volume) -> NDArray[np.float32]:
    """(H, W) best plane as a fractional index: a parabola through the lowest number and its two neighbours."""
    index, least = least_planes(volume)
    picked = np.empty(index.shape, np.float32)
    _pick(volume.values, volume.places, volume.strides, index, least, picked)
    return picked


@kernel
def _pick(
    values: NDArray[np.float32],
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    index: NDArray[np.int64],
    least: NDArray[np.float32],
    picked: NDArray[np.float32],
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
            picked[y, x] = np.float32(index[y, x]) + offset
