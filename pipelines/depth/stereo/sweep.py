"""Plane sweep: how well each inverse depth of a pixel agrees with the neighbouring views.

The score of a hypothesis is the zero-mean normalised cross-correlation of a weighted window, averaged over the best few
neighbours, so that an occlusion in the others does not count (Kang, Szeliski, Chai, CVPR 2001).

The sweep compares windows as if each lay on a plane that faces the camera. In the refinement after it the windows
follow the depth found so far, so slanted surfaces correlate as well as frontal ones and the depth gets finer than the
planes of the sweep.
"""

import numpy as np
from numpy.typing import NDArray

from ...system.lanes import splat, store
from ...system.threads import fused_kernel, inner
from .lane_sampling import with_row_below
from .volume import BLOCK, TILE, UNREACHED, Bands, CostVolume, pixel_of_tile, tiles_of
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

ALIKE = 1e3
"""Likeness by which all pixels of a window count alike: it lies on the surface itself, and needs all of its texture."""


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
) -> CostVolume:
    """Compute the cost, 1 - score, in [0, 2]. Where no view sees the point it is 1, as for a surface without texture.

    Args:
        image: (H, W) intensities 0..1.
        others: (N, H, W) of the other views.
        warps: (N, 3, 4) as of `warps_to`.
        inverse_depths: (D,) of the planes.
        best: how many of the views count at a pixel.
        bands: runs bands of rows on threads.
        tried: (tiles down, tiles across, D) the planes that are there; None: all.
    """
    height, width = image.shape
    if tried is None:
        tried = np.ones((*tiles_of(height, width), len(inverse_depths)), np.bool_)
    cost, wanted = CostVolume.of_tried(height, width, tried), np.ascontiguousarray(tried.transpose(0, 2, 1))
    paired = with_row_below(others)

    def work(first: int, last: int) -> None:
        tile = first // TILE
        _sweep_band(
            image, paired, warps, inverse_depths, wanted[tile], best, first, last, cost.places[tile],
            cost.strides[tile], cost.values,
        )  # fmt: skip

    bands.run(height, work)
    return cost


@fused_kernel
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


@inner(makes_arrays=False)
def _turn(
    block: NDArray[np.float32],
    length: int,
    rows: int,
    width: int,
    places: NDArray[np.int64],
    strides: NDArray[np.int64],
    cost: NDArray[np.float32],
) -> None:
    """Planes side by side for each pixel, out of pixels side by side for each plane."""
    for t in range(len(places)):
        if places[t] >= 0:
            for k in range(rows):
                for x in range(t * TILE, min(t * TILE + TILE, width)):
                    place = places[t] + pixel_of_tile(k, x) * strides[t]
                    for d in range(BLOCK):
                        cost[place + d] = block[(d * rows + k) * length + x]


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
    """Move inverse depth (H, W) to where the views correlate best; image, others, warps, best, bands as `sweep_cost`.

    Args:
        inverse_depth: (H, W) where the moves start.
        step: of inverse depth.
        reach: most steps either way.
        stiffness: a move of n steps costs stiffness * n² of correlation, so that a surface without texture stays.
    """
    refined, paired = np.empty_like(inverse_depth), with_row_below(others)

    def work(first: int, last: int) -> None:
        _refine_band(image, paired, warps, inverse_depth, step, reach, stiffness, best, first, last, refined)

    bands.run(image.shape[0], work)
    return refined


@fused_kernel
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
