"""Gradients of a band: the same walk front to back as the forward pass, with nothing stored per pair.

What lies behind a Gaussian in a pixel is the pixel's total minus what has been blended so far. With q the product of a
Gaussian's values with the gradient of the pixel and S the sum of weight * q of all Gaussians behind it,
d loss / d alpha = light * q - S / (1 - alpha).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..compute.jit import inner, kernel
from ..compute.lanes import add_totals, at_most, counting, exp, load, reciprocal, splat, store, where
from . import reference
from .cpu_bands import BAND_ROWS, RECORD, TILE, first_pixel, last_pixel
from .cpu_forward import CHECK_EVERY, PIXELS, clear, is_opaque

F32 = np.float32
LIGHT, BEHIND, D_DEPTH, D_SEEN = (PIXELS * i for i in range(4))
"""Planes of a tile's state: light as in the forward pass; what is still behind; the gradients of depth sum and
silhouette."""
PLANES = 4
COLORS = 3
"""Features that have gradients: nobody asks for those of class logits."""

_ALPHA_MAX, _LIGHT_MIN = F32(reference.ALPHA_MAX), F32(reference.TRANSMITTANCE_MIN)
_HALF, _ZERO, _ONE = F32(0.5), F32(0), F32(1)


@inner
def open_tile(
    state: NDArray[np.float32],
    image: NDArray[np.float32],
    left: int,
    top: int,
    columns: int,
    rows: int,
    features: NDArray[np.float32],
    planes: NDArray[np.float32],
    d_features: NDArray[np.float32],
    d_planes: NDArray[np.float32],
) -> None:
    """Loads the gradients of the pixels of a tile and everything that will be blended into them."""
    clear(state)
    for y in range(rows):
        for x in range(columns):
            pixel, row, column = TILE * y + x, top + y, left + x
            d_depth, d_depth_seen, d_seen = d_planes[0, row, column], d_planes[1, row, column], d_planes[2, row, column]
            behind = d_seen * planes[2, row, column]
            gradients, values = d_features[row, column], features[row, column]
            for c in range(COLORS):
                image[PIXELS * c + pixel] = gradients[c]
                behind += gradients[c] * values[c]
            state[LIGHT + pixel] = _ONE
            state[D_DEPTH + pixel] = d_depth
            depth_behind = d_depth * planes[0, row, column] + d_depth_seen * planes[1, row, column]
            state[BEHIND + pixel] = behind + depth_behind
            state[D_SEEN + pixel] = d_seen + d_depth_seen


@inner
def pull_rows(
    state: NDArray[np.float32],
    image: NDArray[np.float32],
    features: NDArray[np.float32],
    at: int,
    falloff_y: NDArray[np.float32],
    falloff_x: object,
    dx2: object,
    z: np.float32,
    y_center: np.float32,
    reach2: np.float32,
    first: int,
    last: int,
) -> tuple[object, object, object, object, object, object, object]:
    """Sums over rows first..last, column by column, of m, m dy, m dy² and d loss / d z, with m = alpha * d loss /
    d alpha, and of the gradients of the Gaussian's features, those from `at` on; light and what is behind go on behind
    the Gaussian. The gradients of the image lie in the planes of `image`."""
    red, green, blue = features[at], features[at + 1], features[at + 2]
    pull, pull_y, pull_y2, d_z = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
    d_red, d_green, d_blue = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    for y in range(first, last + 1):
        row = TILE * y
        dy = F32(y) + _HALF - y_center
        light = load(state, LIGHT + row)
        alpha = at_most(falloff_x * falloff_y[y], _ALPHA_MAX)
        alpha = where((dx2 <= splat(reach2 - dy * dy)) & (light >= _LIGHT_MIN), alpha)
        weight = alpha * light
        d_depth, by_red = load(state, D_DEPTH + row), load(image, row)
        by_green, by_blue = load(image, PIXELS + row), load(image, 2 * PIXELS + row)
        q = by_red * red + by_green * green + by_blue * blue + d_depth * z + load(state, D_SEEN + row)
        behind = load(state, BEHIND + row) - weight * q
        store(state, BEHIND + row, behind)
        store(state, LIGHT + row, light - weight)
        d_alpha = light * q - behind * reciprocal(_ONE - alpha)
        m = where(alpha < splat(_ALPHA_MAX), d_alpha * alpha)
        pull, pull_y, pull_y2 = pull + m, pull_y + m * dy, pull_y2 + m * (dy * dy)
        d_z = d_z + weight * d_depth
        d_red, d_green, d_blue = d_red + weight * by_red, d_green + weight * by_green, d_blue + weight * by_blue
    return pull, pull_y, pull_y2, d_z, d_red, d_green, d_blue


@kernel
def backward_band(
    band: int,
    own: NDArray[np.int32],
    first: NDArray[np.int32],
    slots: NDArray[np.int64],
    records: NDArray[np.float32],
    padded: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    features: NDArray[np.float32],
    planes: NDArray[np.float32],
    d_image: NDArray[np.float32],
    d_planes: NDArray[np.float32],
    d_geometry: NDArray[np.float32],
    d_features: NDArray[np.float32],
    shared: NDArray[np.float32],
) -> None:
    """Gradients of the Gaussians seen in a band: of u, v, sigma_px, z, opacity to d_geometry (5, M) and of the features
    to d_features (M, 3), or, where other bands add to them too, to their row of `shared` (S, 8).

    features and planes are the images of the forward pass, d_image and d_planes their gradients.
    """
    height, width = features.shape[:2]
    d_records = np.zeros(8 * len(own), np.float32)
    band_top = band * BAND_ROWS
    across = (width + TILE - 1) // TILE
    image = np.zeros(PIXELS * COLORS, np.float32)
    state = np.empty(PIXELS * PLANES, np.float32)
    falloff_y = np.empty(TILE, np.float32)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        open_tile(state, image, left, top, columns, rows, features, planes, d_image, d_planes)
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
            pull, pull_y, pull_y2, d_z, d_red, d_green, d_blue = pull_rows(
                state, image, padded, i * COLORS, falloff_y, falloff_x, dx2, records[at + 3], v_tile, r * r, y0, y1
            )
            add_totals(d_records, 8 * i + 4, pull, d_red, d_green, d_blue)
            add_totals(d_records, 8 * i, pull * dx, pull_y, pull * dx2 + pull_y2, d_z)
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(state, LIGHT):
                break
    for k in range(len(own)):
        i, at = own[k], 8 * k
        sigma_px, opacity = records[RECORD * k + 2], records[RECORD * k + 4]
        precision = _ONE / (sigma_px * sigma_px)
        d_records[at] *= precision
        d_records[at + 1] *= precision
        d_records[at + 2] *= precision / sigma_px
        d_records[at + 4] /= opacity
        if slots[i + 1] > slots[i]:
            row = shared[slots[i] + band - first[i]]
            for j in range(5 + COLORS):
                row[j] = d_records[at + j]
        else:
            for j in range(5):
                d_geometry[j, i] = d_records[at + j]
            for c in range(COLORS):
                d_features[i, c] = d_records[at + 5 + c]


@kernel
def sum_shared(
    start: int,
    rows: int,
    slots: NDArray[np.int64],
    shared: NDArray[np.float32],
    d_geometry: NDArray[np.float32],
    d_features: NDArray[np.float32],
) -> None:
    """The gradients of the Gaussians in several bands, of `rows` Gaussians from `start` on: the sums of what each of
    the bands has put into their rows of `shared`, always added in the same order."""
    for i in range(start, min(start + rows, len(slots) - 1)):
        if slots[i + 1] == slots[i]:
            continue
        first = shared[slots[i]]
        for k in range(slots[i] + 1, slots[i + 1]):
            for c in range(len(first)):
                first[c] += shared[k, c]
        for j in range(5):
            d_geometry[j, i] = first[j]
        for c in range(COLORS):
            d_features[i, c] = first[5 + c]
