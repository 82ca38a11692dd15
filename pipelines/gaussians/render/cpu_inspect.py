"""One forward walk that keeps what an image does not show: median depth, and how much each Gaussian was seen."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.pipelines.gaussians.render.cpu_bands import (
    BAND_ROWS,
    RECORD,
    TILE,
    first_pixel,
    last_pixel,
    split_into_bands,
)
from msgs_slam.pipelines.gaussians.render.cpu_forward import (
    CHECK_EVERY,
    LIGHT,
    PIXELS,
    PLANES,
    blend_rows,
    clear,
    is_opaque,
    open_tile,
)
from msgs_slam.pipelines.gaussians.render.jit import kernel
from msgs_slam.pipelines.gaussians.render.lanes import (
    counting,
    exp,
    largest,
    largest_of,
    load,
    splat,
    store,
    total,
    where,
)
from msgs_slam.pipelines.gaussians.render.threads import for_each

F32 = np.float32
_HALF, _ZERO = F32(0.5), F32(0)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each; float32 CPU tensors. In
    the sums a pixel counts as counts (H, W) says, as 1 where None."""
    projected = tuple(tensor.detach().contiguous().numpy() for tensor in (u, v, sigma_px, z, opacity))
    no_features = np.zeros((len(u), 0), F32)
    bands = split_into_bands(projected, no_features, 0, width, height, near)
    median = np.empty((height, width), F32)
    counted = np.ones((height, width), F32) if counts is None else counts.contiguous().numpy()
    sums, most = np.zeros(len(u), F32), np.zeros(len(u), F32)
    shared = np.empty((int(bands.slots[-1]), 2), F32)
    results = (counted, median, sums, most, shared)
    places = (bands.first, bands.slots)
    for_each(lambda b: inspect_band(b, bands.own(b), *places, *bands.prepared[b], *results), len(bands))
    if len(straddling := bands.straddling):
        starts = bands.slots[straddling]
        sums[straddling] = np.add.reduceat(shared[:, 0], starts)
        most[straddling] = np.maximum.reduceat(shared[:, 1], starts)
    return torch.from_numpy(median), torch.from_numpy(sums), torch.from_numpy(most)


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
    median: NDArray[np.float32],
    sums: NDArray[np.float32],
    most: NDArray[np.float32],
    shared: NDArray[np.float32],
) -> None:
    """Fills the band's rows of `median`, and `sums` and `most` (or the row of `shared`) of the Gaussians seen in it."""
    height, width = median.shape
    seen = np.zeros((len(own), 2), np.float32)
    band_top = band * BAND_ROWS
    across = (width + TILE - 1) // TILE
    state, weights = np.empty(PIXELS * PLANES, np.float32), np.zeros(PIXELS, np.float32)
    falloff_y, medians = np.empty(TILE, np.float32), np.empty(PIXELS, np.float32)
    count = np.empty(PIXELS, np.float32)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        open_tile(state, None, left, top, columns, rows)
        clear(medians)
        clear(count)
        for y in range(rows):
            for x in range(columns):
                count[TILE * y + x] = counted[top + y, left + x]
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
                found = load(medians, TILE * y)
                here = (light < splat(_HALF)) & (weight > splat(_ZERO)) & (found <= splat(_ZERO))
                store(medians, TILE * y, found + where(here, splat(depth)))
            seen[i, 0] += total(summed)
            seen[i, 1] = max(seen[i, 1], largest_of(top_weight))
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(state, LIGHT):
                break
        for y in range(rows):
            for x in range(columns):
                median[top + y, left + x] = medians[TILE * y + x]
    for k in range(len(own)):
        i = own[k]
        if slots[i + 1] > slots[i]:
            slot = slots[i] + band - first[i]
            shared[slot, 0], shared[slot, 1] = seen[k, 0], seen[k, 1]
        else:
            sums[i], most[i] = seen[k, 0], seen[k, 1]
