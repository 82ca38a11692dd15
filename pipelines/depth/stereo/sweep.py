"""Plane sweep: how well each inverse depth of a pixel agrees with the neighbouring views.

The score of a hypothesis is the zero-mean normalised cross-correlation of a weighted window, averaged over the best few
neighbours, so that an occlusion in the others does not count (Kang, Szeliski, Chai, CVPR 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compute.jit import inner, kernel
from ...compute.lanes import splat, store
from .bands import Bands
from .lane_sampling import with_row_below
from .tiles import TILE, tiles_of
from .volume import BLOCK, UNREACHED, Volume, pixel_of_tile
from .window import (
    LIKENESS,
    RADIUS,
    SAMPLED_ROWS,
    best_mean,
    need_around,
    pad_rows,
    row_length,
    warp_row,
    weigh_windows,
)


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
    tried: NDArray[np.bool_] | None = None,
) -> Volume:
    """Cost 1 - score in [0, 2] of the inverse depths (D,); `others` (N, H, W) lie as the warps say.

    Intensities are 0..1. Where no view sees the point the cost is 1, as for a surface without texture. Of each tile
    only the planes `tried` (tiles down, tiles across, D) are there; None: all.
    """
    height, width = image.shape
    if tried is None:
        tried = np.ones((*tiles_of(height, width), len(inverse_depths)), np.bool_)
    cost, wanted = Volume.of_tried(height, width, tried), np.ascontiguousarray(tried.transpose(0, 2, 1))
    paired = with_row_below(others)

    def work(first: int, last: int) -> None:
        tile = first // TILE
        _sweep_band(
            image, paired, warps, inverse_depths, wanted[tile], best, first, last, cost.places[tile],
            cost.strides[tile], cost.values,
        )  # fmt: skip

    bands.run(height, work)
    return cost


@kernel
def _sweep_band(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    inverse_depths: NDArray[np.float64],
    wanted: NDArray[np.bool_],
    best: int,
    first: int,
    last: int,
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    cost: NDArray[np.float32],
) -> None:
    height, width = image.shape
    views, rows, columns, _ = others.shape
    length = row_length(width)
    samples = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    seen = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    needed = np.zeros(wanted.shape[1] + 1, np.bool_)
    plane, top = np.zeros(length, np.float32), np.empty(16 * best, np.float32)
    reference = pad_rows(image, first, last)
    weights, moments = weigh_windows(reference, length, LIKENESS)
    block = np.empty(BLOCK * (last - first) * length, np.float32)
    for start in range(0, len(inverse_depths), BLOCK):
        block[:] = UNREACHED
        for d in range(min(BLOCK, len(inverse_depths) - start)):
            here = wanted[start + d]
            if not need_around(here, needed):
                continue
            for n in range(views):
                picture = others[n].reshape(-1)
                for k in range(last - first + 2 * RADIUS):
                    y = min(max(first + k - RADIUS, 0), height - 1)
                    warp_row(
                        picture, columns, rows, warps[n], plane, inverse_depths[start + d], y, width, needed,
                        samples, seen, (n * SAMPLED_ROWS + k) * length,
                    )  # fmt: skip
            for t in range(len(here)):
                if here[t]:
                    for k in range(last - first):
                        score = best_mean(samples, seen, weights, reference, moments, length, views, k, t * TILE, top)
                        place = (d * (last - first) + k) * length + t * TILE
                        store(block, place, splat(np.float32(1)) - score)
        _turn(block, length, last - first, width, places[:, start // BLOCK], strides, cost)


@inner
def _turn(
    block: NDArray[np.float32],
    length: int,
    rows: int,
    width: int,
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    cost: NDArray[np.float32],
) -> None:
    """Planes side by side for each pixel, out of pixels side by side for each plane: writing each plane would miss the
    cache at every pixel."""
    for t in range(len(places)):
        if places[t] >= 0:
            for k in range(rows):
                for x in range(t * TILE, min(t * TILE + TILE, width)):
                    place = places[t] + pixel_of_tile(k, x) * strides[t]
                    for d in range(BLOCK):
                        cost[place + d] = block[(d * rows + k) * length + x]
