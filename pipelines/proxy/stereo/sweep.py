"""Plane sweep: how well each inverse depth of a pixel agrees with the neighbouring views.

The score of a hypothesis is the zero-mean normalised cross-correlation of a weighted window, averaged over the best few
neighbours, so that an occlusion in the others does not count (Kang, Szeliski, Chai, CVPR 2001).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.gaussians.render.jit import kernel
from msgs_slam.pipelines.gaussians.render.lanes import splat, store
from msgs_slam.pipelines.proxy.stereo.bands import Bands
from msgs_slam.pipelines.proxy.stereo.tiles import TILE, tiles_of
from msgs_slam.pipelines.proxy.stereo.window import (
    LIKENESS,
    RADIUS,
    SAMPLED_ROWS,
    best_mean,
    row_length,
    warp_row,
    weigh_windows,
)

_PLANES = 16
"""So many at a time fit into the cache."""
UNTRIED = 2.0
"""Cost of a plane that is not tried: as of a match that could not be worse."""


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
) -> NDArray[np.float32]:
    """(H, W, D) cost 1 - score in [0, 2] of every inverse depth; `others` (N, H, W) lie as the warps say.

    Intensities are 0..1. Where no view sees the point the cost is 1, as for a surface without texture. Of each tile
    only the planes `tried` (tiles down, tiles across, D) are compared; others cost UNTRIED. None: all are tried.
    """
    height, width = image.shape
    cost = np.empty((height, width, len(inverse_depths)), np.float32)
    if tried is None:
        tried = np.ones((*tiles_of(height, width), len(inverse_depths)), np.bool_)
    wanted = np.ascontiguousarray(tried.transpose(0, 2, 1))

    def work(first: int, last: int) -> None:
        _sweep_band(image, others, warps, inverse_depths, wanted[first // TILE], best, first, last, cost)

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
    cost: NDArray[np.float32],
) -> None:
    height, width = image.shape
    views, rows, columns = others.shape
    length = row_length(width)
    samples = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    seen = np.zeros(views * SAMPLED_ROWS * length, np.float32)
    needed = np.zeros(wanted.shape[1], np.bool_)
    plane, top = np.zeros(length, np.float32), np.empty(16 * best, np.float32)
    weights, weighted, moments = weigh_windows(image, first, last, LIKENESS)
    block = np.empty(_PLANES * (last - first) * length, np.float32)
    for start in range(0, len(inverse_depths), _PLANES):
        count = min(_PLANES, len(inverse_depths) - start)
        for d in range(count):
            here = wanted[start + d]
            for b in range(len(here)):
                needed[b] = here[b] or (b > 0 and here[b - 1]) or (b + 1 < len(here) and here[b + 1])
            for n in range(views):
                picture = others[n].reshape(-1)
                for k in range(last - first + 2 * RADIUS):
                    y = min(max(first + k - RADIUS, 0), height - 1)
                    warp_row(
                        picture, columns, rows, warps[n], plane, inverse_depths[start + d], y, width, needed,
                        samples, seen, (n * SAMPLED_ROWS + k) * length,
                    )  # fmt: skip
            for k in range(last - first):
                for x in range(0, width, TILE):
                    place = (d * (last - first) + k) * length + x
                    if not here[x // TILE]:
                        store(block, place, splat(np.float32(UNTRIED)))
                        continue
                    score = best_mean(samples, seen, weights, weighted, moments, length, views, k, x, top)
                    store(block, place, splat(np.float32(1)) - score)
        # Turned round some planes at a time: writing each into (H, W, D) would miss the cache at every pixel.
        for k in range(last - first):
            for x in range(width):
                for d in range(count):
                    cost[first + k, x, start + d] = block[(d * (last - first) + k) * length + x]
