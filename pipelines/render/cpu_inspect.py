"""One forward walk that keeps what an image does not show: median depth, and how much each Gaussian was seen."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compute.lanes import load, maximum, reduce_max, splat, store, total, where
from ..compute.threads import fused_kernel, inlined, inner
from .cpu_bands import PIXELS, TILE, Bands, clear, for_each_band, split_into_bands, walk_tiles
from .cpu_forward import DEPTH_SUM, WEIGHTS, blend_rows, paint_rows

F32 = np.float32
MEDIAN, COUNT, PLANES = 2 * PIXELS, 3 * PIXELS, 4
"""Planes of a tile's state behind those of `blend_rows`: median depths, and what a pixel counts."""
ONLY, IS_MIXED = PIXELS, PIXELS + 1
"""Behind the classes of a tile's pixels: the class that is seen, and 1 where there are more."""
STRENGTH, CHANNEL, LOOKED = 3, 4, 5
"""Of a Gaussian's features that are looked at: behind its colours how sure its class is, the class, and how many."""
_HALF, _ZERO = F32(0.5), F32(0)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Find the median depth (H, W), and the summed and largest blending weight of each Gaussian, (M,) each; float32 CPU
    tensors. In the sums a pixel counts as counts (H, W) says, as 1 where None."""
    bands = bands_of((u, v, sigma_px, z, opacity), None, width, height, near)
    counted = torch.ones(height, width) if counts is None else counts
    median, found = _walk(bands, counted, torch.zeros(height, width, dtype=torch.uint8), 0)
    return median, found[:, 0], found[:, 1]


def class_weights(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, near: float, counts: Tensor, channels: Tensor,
    classes: int,
) -> Tensor:  # fmt: skip
    """Sum the blending weights (M, classes) of each Gaussian over the pixels of each of the channels (H, W) uint8; what
    is no class counts nothing, the others as counts (H, W) says; float32 CPU tensors."""
    height, width = channels.shape
    bands, known = bands_of((u, v, sigma_px, z, opacity), None, width, height, near), channels < classes
    return _walk(bands, torch.where(known, counts, 0.0), torch.where(known, channels, 0), classes)[1][:, 2:]


def look(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, features: Tensor, classes: int, width: int,
    height: int, near: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Draw colours (H, W, 3), and (H, W) each the depth sum, silhouette, median depth, and of the classes the largest
    sum of strengths and the one that has it; features (M, 5): colour, strength, class; float32 CPU tensors."""
    bands = bands_of((u, v, sigma_px, z, opacity), features, width, height, near)
    colors, planes = np.empty((height, width, 3), F32), np.empty((5, height, width), F32)
    for_each_band(lambda b: look_band(classes, b, *bands.prepared[b], colors, planes), bands.starts)
    return torch.from_numpy(colors), *torch.from_numpy(planes).unbind(0)


def bands_of(gaussians: tuple[Tensor, ...], colors: Tensor | None, width: int, height: int, near: float) -> Bands:
    """Make the bands of projected Gaussians, with or without features."""
    projected = tuple(tensor.detach().contiguous().numpy() for tensor in gaussians)
    features = np.zeros((len(projected[0]), 0), F32) if colors is None else colors.detach().contiguous().numpy()
    return split_into_bands(projected, features, features.shape[1], width, height, near)


def _walk(bands: Bands, counts: Tensor, channels: Tensor, classes: int) -> tuple[Tensor, Tensor]:
    """Median depth (H, W), and of each Gaussian its weights' sum, the largest, and the sums by class, (M, 2 + C)."""
    (height, width), count = counts.shape, len(bands.first)
    median, found = np.empty((height, width), F32), np.zeros((count, 2 + classes), F32)
    shared = np.empty((int(bands.slots[-1]), 2 + classes), F32)
    given = (counts.contiguous().numpy(), channels.contiguous().numpy(), median, found, shared)
    places = (bands.first, bands.slots)
    for_each_band(lambda b: inspect_band(b, bands.own(b), *places, *bands.prepared[b], *given), bands.starts)
    if len(straddling := bands.straddling):
        starts = bands.slots[straddling]
        found[straddling] = np.add.reduceat(shared, starts)
        found[straddling, 1] = np.maximum.reduceat(shared[:, 1], starts)
    return torch.from_numpy(median), torch.from_numpy(found)


@inner
def open_counts(job: tuple[Any, ...], kind: None, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Load what the pixels count and their classes; note whether the tile shows more than one of them, or which."""
    state, classes, counted, channels = job[0], job[1], job[3], job[4]
    left, top, columns, rows = tile
    clear(state)
    only, is_mixed = -1, 0
    for y in range(rows):
        for x in range(columns):
            pixel, count, own_channel = TILE * y + x, counted[top + y, left + x], int(channels[top + y, left + x])
            state[COUNT + pixel], classes[pixel] = count, own_channel
            if count > _ZERO:
                if only >= 0 and only != own_channel:
                    is_mixed = 1
                only = own_channel
    classes[ONLY], classes[IS_MIXED] = only, is_mixed


@inner
def note_median(state: NDArray[np.float32], row: int, weight: Any, behind: Any, depth: np.float32) -> None:
    """Note the depth of a Gaussian behind which less than half of the light is left, where no nearer one is noted."""
    before = load(state, MEDIAN + row)
    here = (behind < splat(_HALF)) & (weight > splat(_ZERO)) & (before <= splat(_ZERO))
    store(state, MEDIAN + row, before + where(here, splat(depth)))


@inlined
def weigh(
    job: tuple[Any, ...], kind: None, light: NDArray[np.float32], falloff_y: NDArray[np.float32], i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Add one Gaussian's weights in a tile, and note where half of the light is lost in it."""
    state, classes, seen = job[0], job[1], job[2]
    x0, x1, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    summed, top_weight = splat(_ZERO), splat(_ZERO)
    for row in range(TILE * y0, TILE * y1 + TILE, TILE):
        weight, behind = load(state, WEIGHTS + row), load(light, row)
        summed, top_weight = summed + weight * load(state, COUNT + row), maximum(top_weight, weight)
        note_median(state, row, weight, behind, pair[5])
    sum_here = total(summed)
    seen[i, 0] += sum_here
    seen[i, 1] = max(seen[i, 1], reduce_max(top_weight))
    if seen.shape[1] > 2 and classes[IS_MIXED] == 0:  # most tiles show one class
        seen[i, 2 + max(classes[ONLY], 0)] += sum_here
    elif seen.shape[1] > 2:
        for y in range(y0, y1 + 1):
            for pixel in range(TILE * y + x0, TILE * y + x1 + 1):
                seen[i, 2 + classes[pixel]] += state[WEIGHTS + pixel] * state[COUNT + pixel]


@inner
def close_counts(job: tuple[Any, ...], kind: None, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Write the tile's median depths."""
    state, median = job[0], job[5]
    left, top, columns, rows = tile
    for y in range(rows):
        for x in range(columns):
            median[top + y, left + x] = state[MEDIAN + TILE * y + x]


@fused_kernel
def inspect_band(
    band: int,
    own: NDArray[np.int32],
    first: NDArray[np.int32],
    slots: NDArray[np.int64],
    records: NDArray[np.float32],
    padded: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    counted: NDArray[np.float32],
    channels: NDArray[np.uint8],
    median: NDArray[np.float32],
    found: NDArray[np.float32],
    shared: NDArray[np.float32],
) -> None:
    """Fill the band's rows of `median`, and those of `found` (or of `shared`) of the Gaussians seen in it."""
    height, width = median.shape
    seen = np.zeros((len(own), found.shape[1]), np.float32)
    state, classes = np.empty(PLANES * PIXELS, F32), np.zeros(PIXELS + 2, np.int64)
    job = (state, classes, seen, counted, channels, median)
    visitors = (open_counts, weigh, close_counts)
    walk_tiles(visitors, job, None, band, tile_starts, members, records, width, height)
    for k in range(len(own)):
        i = own[k]
        row = shared[slots[i] + band - first[i]] if slots[i + 1] > slots[i] else found[i]
        for c in range(found.shape[1]):
            row[c] = seen[k, c]


@inner
def open_look(job: tuple[Any, ...], classes: int, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Empty the tile's image, its depths and the planes of its classes."""
    clear(job[0])
    clear(job[1])


@inlined
def see(
    job: tuple[Any, ...], classes: int, light: NDArray[np.float32], falloff_y: NDArray[np.float32], i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Blend one Gaussian's colours, and its strength into the plane of its class; note the median depth."""
    image, state, features = job[0], job[1], job[2]
    _, _, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    paint_rows(image, state, features, LOOKED * i, y0, y1)
    strength, plane = features[LOOKED * i + STRENGTH], PIXELS * (3 + int(features[LOOKED * i + CHANNEL]))
    for row in range(TILE * y0, TILE * y1 + TILE, TILE):
        weight = load(state, WEIGHTS + row)
        store(image, plane + row, load(image, plane + row) + weight * strength)
        note_median(state, row, weight, load(light, row), pair[5])


@inner
def close_look(job: tuple[Any, ...], classes: int, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Write the tile into the images."""
    image, state, colors, planes = job[0], job[1], job[3], job[4]
    left, top, columns, rows = tile
    for y in range(rows):
        for x in range(columns):
            pixel, best = TILE * y + x, 0
            for c in range(3):
                colors[top + y, left + x, c] = image[PIXELS * c + pixel]
            for c in range(1, classes):
                if image[PIXELS * (3 + c) + pixel] > image[PIXELS * (3 + best) + pixel]:
                    best = c
            planes[0, top + y, left + x] = state[DEPTH_SUM + pixel]
            planes[1, top + y, left + x] = F32(1) - light[pixel]
            planes[2, top + y, left + x] = state[MEDIAN + pixel]
            planes[3, top + y, left + x] = image[PIXELS * (3 + best) + pixel]
            planes[4, top + y, left + x] = best


@fused_kernel
def look_band(
    classes: int,
    band: int,
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    colors: NDArray[np.float32],
    planes: NDArray[np.float32],
) -> None:
    """Fill the band's rows of what `look` returns."""
    height, width = colors.shape[:2]
    image, state = np.empty(PIXELS * (3 + max(classes, 1)), np.float32), np.empty(3 * PIXELS, np.float32)
    job = (image, state, features, colors, planes)
    walk_tiles((open_look, see, close_look), job, classes, band, tile_starts, members, records, width, height)
