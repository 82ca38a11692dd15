"""Blending a band: Gaussians outermost, then the rows of a tile, sixteen pixels of a row at once.

An isotropic Gaussian is a product of a function of x and one of y: a tile needs two vectors of exponentials for it, not
one per row. A tile's pixels keep their state in planes of one flat array, see the `PLANE` constants.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..compute.jit import inner, kernel
from ..compute.lanes import any_of, at_most, counting, exp, largest, load, splat, store, where
from . import reference
from .boxes import add_to_box
from .cpu_bands import BAND_ROWS, RECORD, TILE, Bands, first_pixel, for_each_band, last_pixel

F32 = np.float32
PIXELS = TILE * TILE
LIGHT, DEPTH_SUM = 0, PIXELS
"""Where the planes of the tile's state start: transmittance, and the sum of weighted depths."""
PLANES = 2
Vectors: TypeAlias = tuple[int, ...] | None
"""A tuple with one 0 per sixteen channels of a pixel, which lie side by side: its type tells the kernels how many
vectors a pixel has. None for three channels, which lie in planes as the rest of a tile's state does:
one vector is sixteen pixels of a channel instead of a pixel's sixteen channels, at two thirds of the time."""
CHECK_EVERY = 32  # Gaussians between two looks at whether the whole tile is opaque

_ALPHA_MAX, _LIGHT_MIN = F32(reference.ALPHA_MAX), F32(reference.TRANSMITTANCE_MIN)
_HALF, _ZERO, _ONE = F32(0.5), F32(0), F32(1)


@inner
def channels_of(vectors: Vectors) -> int:
    """Numbers that a tile keeps of a pixel's features, and a band of a Gaussian's."""
    if vectors is None:
        return 3
    else:
        return 16 * len(vectors)


@inner
def clear(numbers: NDArray[np.float32]) -> None:
    """Zeros. A slice assignment does the same but takes long to compile."""
    for i in range(len(numbers)):
        numbers[i] = _ZERO


@inner
def open_tile(
    state: NDArray[np.float32],
    columns: int,
    rows: int,
) -> None:
    """Full light for the pixels of the image, none for the rest of the tile, so that nothing is blended there."""
    clear(state)
    for y in range(rows):
        for x in range(columns):
            state[LIGHT + TILE * y + x] = _ONE


@inner
def is_opaque(state: NDArray[np.float32], plane: int) -> bool:
    """Whether no pixel of the tile takes any more light."""
    most = load(state, plane)
    for y in range(1, TILE):
        most = largest(most, load(state, plane + TILE * y))
    return not any_of(most >= _LIGHT_MIN)


@inner
def blend_rows(
    state: NDArray[np.float32],
    weights: NDArray[np.float32],
    falloff_y: NDArray[np.float32],
    falloff_x: object,
    dx2: object,
    y_center: np.float32,
    reach2: np.float32,
    z: np.float32,
    first: int,
    last: int,
) -> None:
    """Weights of one Gaussian in rows first..last of a tile; light and depth sum go on behind it."""
    for y in range(first, last + 1):
        row = TILE * y
        dy = F32(y) + _HALF - y_center
        alpha = at_most(falloff_x * falloff_y[y], _ALPHA_MAX)
        light = load(state, LIGHT + row)
        alpha = where((dx2 <= splat(reach2 - dy * dy)) & (light >= _LIGHT_MIN), alpha)
        weight = alpha * light
        store(weights, row, weight)
        store(state, LIGHT + row, light - weight)
        store(state, DEPTH_SUM + row, load(state, DEPTH_SUM + row) + weight * z)


@inner
def paint_rows(
    image: NDArray[np.float32],
    weights: NDArray[np.float32],
    features: NDArray[np.float32],
    at: int,
    first: int,
    last: int,
) -> None:
    """Three features, those from `at` on, into the three planes of a tile's image, sixteen pixels at once."""
    red, green, blue = features[at], features[at + 1], features[at + 2]
    for row in range(TILE * first, TILE * last + TILE, TILE):
        weight = load(weights, row)
        store(image, row, load(image, row) + weight * red)
        store(image, PIXELS + row, load(image, PIXELS + row) + weight * green)
        store(image, 2 * PIXELS + row, load(image, 2 * PIXELS + row) + weight * blue)


def draw_bands(
    bands: Bands, vectors: Vectors, channels: int, width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The image (H, W, channels) of all bands, and depth sum, depth silhouette and silhouette (3, H, W)."""
    features, planes = np.empty((height, width, channels), F32), np.empty((3, height, width), F32)
    for_each_band(lambda b: forward_band(vectors, b, *bands.prepared[b], features, planes), bands.starts)
    return features, planes


@kernel
def forward_band(
    vectors: Vectors,
    band: int,
    records: NDArray[np.float32],
    padded: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    out_features: NDArray[np.float32],
    out_planes: NDArray[np.float32],
) -> None:
    """Fills the band's rows of the feature image (H, W, C) and of depth sum, depth silhouette, silhouette (3, H, W)."""
    height, width, used = out_features.shape
    channels = channels_of(vectors)
    band_top = band * BAND_ROWS
    across = (width + TILE - 1) // TILE
    image = np.empty(PIXELS * channels, np.float32)
    state = np.empty(PIXELS * PLANES, np.float32)
    weights, falloff_y = np.zeros(PIXELS, np.float32), np.empty(TILE, np.float32)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        open_tile(state, columns, rows)
        clear(image)
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = members[k]
            at = RECORD * i
            u_tile, v_tile, r = records[at] - F32(left), records[at + 1] - F32(top), records[at + 5]
            x0, x1 = first_pixel(u_tile - r), last_pixel(u_tile + r, columns)
            y0, y1 = first_pixel(v_tile - r), last_pixel(v_tile + r, rows)
            if x1 < x0 or y1 < y0:
                continue
            sharpness = -_HALF / (records[at + 2] * records[at + 2])
            dx = counting(_HALF - u_tile)
            dy = counting(_HALF - v_tile)
            dx2 = dx * dx
            falloff_x = exp(dx2 * sharpness)
            store(falloff_y, 0, exp(dy * dy * sharpness) * records[at + 4])
            depth = records[at + 3]
            blend_rows(state, weights, falloff_y, falloff_x, dx2, v_tile, r * r, depth, y0, y1)
            if vectors is None:
                paint_rows(image, weights, padded, i * channels, y0, y1)
            else:
                corner = TILE * y0 + x0
                add_to_box(
                    image, corner * channels, padded, i * channels, weights, corner, y1 - y0 + 1, x1 - x0 + 1, vectors
                )
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(state, LIGHT):
                break
        for y in range(rows):
            for x in range(columns):
                pixel = TILE * y + x
                row = out_features[top + y, left + x]
                for c in range(used):
                    row[c] = image[PIXELS * c + pixel if vectors is None else pixel * channels + c]
                seen = _ONE - state[LIGHT + pixel]
                out_planes[0, top + y, left + x] = state[DEPTH_SUM + pixel]
                out_planes[1, top + y, left + x] = seen
                out_planes[2, top + y, left + x] = seen
