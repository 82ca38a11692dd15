"""One forward walk that keeps what an image does not show: median depth, and how much each Gaussian was seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..compute.jit import kernel
from ..compute.lanes import counting, exp, largest, largest_of, load, splat, store, total, where
from .cpu_bands import BAND_ROWS, RECORD, TILE, Bands, first_pixel, for_each_band, last_pixel, split_into_bands
from .cpu_forward import CHECK_EVERY, LIGHT, PIXELS, PLANES, blend_rows, clear, draw_bands, is_opaque, open_tile

F32 = np.float32
_HALF, _ZERO = F32(0.5), F32(0)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each; float32 CPU tensors. In
    the sums a pixel counts as counts (H, W) says, as 1 where None."""
    bands = bands_of((u, v, sigma_px, z, opacity), None, width, height, near)
    counted = torch.ones(height, width) if counts is None else counts
    median, found = _walk(bands, counted, torch.zeros(height, width, dtype=torch.uint8), 0)
    return median, found[:, 0], found[:, 1]


def weighted_errors(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, colors: Tensor, width: int, height: int,
    near: float, error_of: Callable[[Tensor], Tensor],
) -> Tensor:  # fmt: skip
    """(M,) blending weights of each Gaussian, summed over the pixels, each weighed with its error: `error_of` the
    (H, W, 3) colours that are shown, (H, W); float32 CPU tensors."""
    bands = bands_of((u, v, sigma_px, z, opacity), colors, width, height, near)
    shown, _ = draw_bands(bands, None, 3, width, height)
    errors = error_of(torch.from_numpy(shown))
    return _walk(bands, errors, torch.zeros(height, width, dtype=torch.uint8), 0)[1][:, 0]


def class_weights(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, near: float, counts: Tensor, channels: Tensor,
    classes: int,
) -> Tensor:  # fmt: skip
    """(M, classes) blending weights of each Gaussian, summed over the pixels of each of the channels (H, W) uint8; what
    is no class counts nothing, the others as counts (H, W) says; float32 CPU tensors."""
    height, width = channels.shape
    bands, known = bands_of((u, v, sigma_px, z, opacity), None, width, height, near), channels < classes
    return _walk(bands, torch.where(known, counts, 0.0), torch.where(known, channels, 0), classes)[1][:, 2:]


def bands_of(gaussians: tuple[Tensor, ...], colors: Tensor | None, width: int, height: int, near: float) -> Bands:
    """The bands of projected Gaussians, with or without three features."""
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


@kernel
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
    """Fills the band's rows of `median`, and those of `found` (or of `shared`) of the Gaussians seen in it."""
    height, width = median.shape
    columns_found = found.shape[1]
    seen = np.zeros((len(own), columns_found), np.float32)
    band_top = band * BAND_ROWS
    across = (width + TILE - 1) // TILE
    state, weights = np.empty(PIXELS * PLANES, np.float32), np.zeros(PIXELS, np.float32)
    falloff_y, medians = np.empty(TILE, np.float32), np.empty(PIXELS, np.float32)
    count, channel = np.empty(PIXELS, np.float32), np.zeros(PIXELS, np.int64)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        open_tile(state, columns, rows)
        clear(medians)
        clear(count)
        only, is_mixed = -1, False
        for y in range(rows):
            for x in range(columns):
                count[TILE * y + x] = counted[top + y, left + x]
                own_channel = int(channels[top + y, left + x])
                channel[TILE * y + x] = own_channel
                if count[TILE * y + x] > _ZERO:
                    is_mixed = is_mixed or (only >= 0 and only != own_channel)
                    only = own_channel
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = members[k]
            at = RECORD * i
            u_tile, v_tile, r = records[at] - F32(left), records[at + 1] - F32(top), records[at + 5]
            y0, y1 = first_pixel(v_tile - r), last_pixel(v_tile + r, rows)
            if y1 < y0:
                continue
            sharpness = -_HALF / (records[at + 2] * records[at + 2])
            dx, dy = counting(_HALF - u_tile), counting(_HALF - v_tile)
            dx2 = dx * dx
            store(falloff_y, 0, exp(dy * dy * sharpness) * records[at + 4])
            depth = records[at + 3]
            blend_rows(state, weights, falloff_y, exp(dx2 * sharpness), dx2, v_tile, r * r, depth, y0, y1)
            summed, top_weight = splat(_ZERO), splat(_ZERO)
            for y in range(y0, y1 + 1):
                weight, light = load(weights, TILE * y), load(state, LIGHT + TILE * y)
                summed, top_weight = summed + weight * load(count, TILE * y), largest(top_weight, weight)
                before = load(medians, TILE * y)
                here = (light < splat(_HALF)) & (weight > splat(_ZERO)) & (before <= splat(_ZERO))
                store(medians, TILE * y, before + where(here, splat(depth)))
            sum_here = total(summed)
            seen[i, 0] += sum_here
            seen[i, 1] = max(seen[i, 1], largest_of(top_weight))
            if columns_found > 2 and not is_mixed:  # most tiles show one class
                seen[i, 2 + max(only, 0)] += sum_here
            elif columns_found > 2:
                x0, x1 = first_pixel(u_tile - r), last_pixel(u_tile + r, columns)
                for y in range(y0, y1 + 1):
                    for pixel in range(TILE * y + x0, TILE * y + x1 + 1):
                        seen[i, 2 + channel[pixel]] += weights[pixel] * count[pixel]
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(state, LIGHT):
                break
        for y in range(rows):
            for x in range(columns):
                median[top + y, left + x] = medians[TILE * y + x]
    for k in range(len(own)):
        i = own[k]
        row = shared[slots[i] + band - first[i]] if slots[i + 1] > slots[i] else found[i]
        for c in range(columns_found):
            row[c] = seen[k, c]
