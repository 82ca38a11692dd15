"""Blending a band: Gaussians outermost, then the rows of a tile, sixteen pixels of a row at once."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..compute.lanes import add_to_box, load, store
from ..compute.threads import fused_kernel, inlined, inner
from .cpu_bands import PIXELS, TILE, Bands, clear, for_each_band, row_opacity, walk_tiles

F32 = np.float32
Vectors: TypeAlias = tuple[int, ...] | None
"""A tuple with one 0 per sixteen channels of a pixel, which lie side by side: its type tells the kernels how many
vectors a pixel has. None for three channels, which lie in planes as the rest of a tile's state does:
one vector is sixteen pixels of a channel instead of a pixel's sixteen channels, at two thirds of the time."""
DEPTH_SUM, WEIGHTS = 0, PIXELS
"""Planes of a tile's state, beside its light: the sum of weighted depths, and the weights of the Gaussian at hand."""
_ONE = F32(1)


def vectors_for(channels: int) -> Vectors:
    """Return how so many channels of a pixel lie."""
    return None if channels == 3 else (0,) * max(1, (channels + 15) // 16)


def padded_channels(channels: int) -> int:
    """Return how many numbers a tile keeps of a pixel's channels, and a band of a Gaussian's."""
    vectors = vectors_for(channels)
    return 3 if vectors is None else 16 * len(vectors)


def draw_bands(bands: Bands, channels: int, width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw the image (H, W, channels) of all bands, and depth sum, depth silhouette and silhouette (3, H, W)."""
    features, planes = np.empty((height, width, channels), F32), np.empty((3, height, width), F32)
    vectors, padded = vectors_for(channels), padded_channels(channels)
    for_each_band(lambda b: forward_band(vectors, padded, b, *bands.prepared[b], features, planes), bands.starts)
    return features, planes


@inner
def open_drawing(job: tuple[Any, ...], vectors: Vectors, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Empty the tile's image and depth sums."""
    image, state = job[0], job[1]
    clear(image)
    clear(state)


@inner
def blend_rows(
    light: NDArray[np.float32], state: NDArray[np.float32], falloff_y: NDArray[np.float32], first: int, last: int,
    pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Weights of one Gaussian in rows first..last of a tile; light and depth sum go on behind it."""
    depth = pair[5]
    for y in range(first, last + 1):
        row = TILE * y
        before = load(light, row)
        weight = row_opacity(y, before, falloff_y, pair) * before
        store(state, WEIGHTS + row, weight)
        store(light, row, before - weight)
        store(state, DEPTH_SUM + row, load(state, DEPTH_SUM + row) + weight * depth)


@inlined
def blend(
    job: tuple[Any, ...], vectors: Vectors, light: NDArray[np.float32], falloff_y: NDArray[np.float32], i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Blend one Gaussian into the tile's image."""
    image, state, padded, channels = job[0], job[1], job[2], job[3]
    x0, x1, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    if vectors is None:
        paint_rows(image, state, padded, i * 3, y0, y1)
    else:
        corner = TILE * y0 + x0
        add_to_box(
            image, corner * channels, padded, i * channels, state, WEIGHTS + corner, y1 - y0 + 1, x1 - x0 + 1, vectors
        )


@inner
def paint_rows(
    image: NDArray[np.float32], state: NDArray[np.float32], features: NDArray[np.float32], at: int, first: int,
    last: int,
) -> None:  # fmt: skip
    """Add three features, those from `at` on, to the three planes of a tile's image, sixteen pixels at once."""
    red, green, blue = features[at], features[at + 1], features[at + 2]
    for row in range(TILE * first, TILE * last + TILE, TILE):
        weight = load(state, WEIGHTS + row)
        store(image, row, load(image, row) + weight * red)
        store(image, PIXELS + row, load(image, PIXELS + row) + weight * green)
        store(image, 2 * PIXELS + row, load(image, 2 * PIXELS + row) + weight * blue)


@inner
def close_drawing(job: tuple[Any, ...], vectors: Vectors, light: NDArray[np.float32], tile: tuple[int, ...]) -> None:
    """Write the tile into the images."""
    image, state, channels, out_features, out_planes = job[0], job[1], job[3], job[4], job[5]
    left, top, columns, rows = tile
    for y in range(rows):
        for x in range(columns):
            pixel = TILE * y + x
            row = out_features[top + y, left + x]
            for c in range(len(row)):
                row[c] = image[PIXELS * c + pixel if vectors is None else pixel * channels + c]
            seen = _ONE - light[pixel]
            out_planes[0, top + y, left + x] = state[DEPTH_SUM + pixel]
            out_planes[1, top + y, left + x] = seen
            out_planes[2, top + y, left + x] = seen


@fused_kernel
def forward_band(
    vectors: Vectors,
    channels: int,
    band: int,
    records: NDArray[np.float32],
    padded: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    out_features: NDArray[np.float32],
    out_planes: NDArray[np.float32],
) -> None:
    """Fill the band's rows of the feature image (H, W, C) and of depth sum, depth silhouette, silhouette (3, H, W)."""
    height, width = out_features.shape[:2]
    image, state = np.empty(PIXELS * channels, np.float32), np.empty(2 * PIXELS, np.float32)
    job = (image, state, padded, channels, out_features, out_planes)
    visitors = (open_drawing, blend, close_drawing)
    walk_tiles(visitors, job, vectors, band, tile_starts, members, records, width, height)
