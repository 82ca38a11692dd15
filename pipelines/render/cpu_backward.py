"""Gradients of a band: the same walk front to back as the forward pass, with nothing stored per pair.

What lies behind a Gaussian in a pixel is the pixel's total minus what has been blended so far. With q the product of a
Gaussian's values with the gradient of the pixel and S the sum of weight * q of all Gaussians behind it,
d loss / d alpha = light * q - S / (1 - alpha).
"""

from typing import Any

import numpy as np

from ..system.lanes import add_totals, load, maximum, reciprocal, reduce_max, splat, store, total, where
from ..system.threads import PART, Floats, Ints, Longs, for_each, fused_kernel, inlined, inner
from . import rules
from .cpu_bands import (
    PIXELS,
    RECORD,
    TILE,
    ImageBands,
    Vectors,
    clear,
    for_each_band,
    row_opacity,
    vectors_for,
    walk_tiles,
)

F32 = np.float32
BEHIND, D_DEPTH, D_SEEN, WEIGHTS, ERROR, COUNT = (PIXELS * i for i in range(6))
"""Planes of a tile's state: what is still behind; the gradients of depth sum and silhouette; weights of a Gaussian;
the errors of the pixels and what they count, where `GaussianStats` are asked for."""
PLANES = 6
COLORS = 3
GEOMETRY = 5
"""u, v, sigma_px, z, opacity."""

_ALPHA_MAX = F32(rules.ALPHA_MAX)
_HALF, _ZERO, _ONE = F32(0.5), F32(0), F32(1)


def pull_back(
    bands: ImageBands, features: Floats, planes: Floats, d_features: Floats,
    d_planes: Floats, marks: Floats | None = None,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Return the gradients of the Gaussians' u, v, sigma_px, z, opacity (5, M) and of their features (M, C); and (M, 2)
    the largest blending weight of each and the errors of the pixels weighed by it and summed, (0, 2) without marks.

    Args:
        bands: as the forward pass had them.
        features, planes: its images (H, W, C) and (3, H, W).
        d_features, d_planes: their gradients.
        marks: (2, H, W), the error of each pixel, and 1 where its weights count for the largest.
    """
    count, used = len(bands.first), features.shape[2]
    d_geometry, d_values = np.zeros((GEOMETRY, count), F32), np.zeros((count, used), F32)
    shared = np.empty((int(bands.slots[-1]), GEOMETRY + used), F32)
    noted, noted_apart = (np.zeros((n if marks is not None else 0, 2), F32) for n in (count, len(shared)))
    asked = (np.zeros((2, 0, 0), F32) if marks is None else marks, noted, noted_apart)
    given = (features, planes, d_features, d_planes, d_geometry, d_values, shared, *asked)
    vectors, places = vectors_for(used), (bands.first, bands.slots)
    for_each_band(lambda b: backward_band(vectors, b, bands.own(b), *places, *bands.prepared[b], *given), bands.starts)
    for_each(lambda n: sum_shared(n * PART, PART, bands.slots, shared, d_geometry, d_values), -(-count // PART))
    if marks is not None and len(straddling := bands.straddling):
        starts = bands.slots[straddling]
        noted[straddling, 0] = np.maximum.reduceat(noted_apart[:, 0], starts)
        noted[straddling, 1] = np.add.reduceat(noted_apart[:, 1], starts)
    return d_geometry, d_values, noted


@inner
def open_gradients(job: tuple[Any, ...], vectors: Vectors, light: Floats, tile: tuple[int, ...]) -> None:
    """Load the gradients of the pixels of a tile and everything that will be blended into them."""
    state, image, _, _, features, planes, d_features, d_planes, marks, _ = job
    left, top, columns, rows = tile
    clear(state)
    for y in range(rows):
        for x in range(columns):
            pixel, row, column = TILE * y + x, top + y, left + x
            d_depth, d_depth_seen, d_seen = d_planes[0, row, column], d_planes[1, row, column], d_planes[2, row, column]
            behind = d_seen * planes[2, row, column]
            gradients, values = d_features[row, column], features[row, column]
            for c in range(COLORS if vectors is None else len(values)):
                image[PIXELS * c + pixel] = gradients[c]
                behind += gradients[c] * values[c]
            state[D_DEPTH + pixel] = d_depth
            depth_behind = d_depth * planes[0, row, column] + d_depth_seen * planes[1, row, column]
            state[BEHIND + pixel] = behind + depth_behind
            state[D_SEEN + pixel] = d_seen + d_depth_seen
            if marks.size > 0:
                state[ERROR + pixel], state[COUNT + pixel] = marks[0, row, column], marks[1, row, column]


@inner
def pull_alpha(
    state: Floats, light: Floats, row: int, before: Any, alpha: Any, weight: Any,
    q: Any,
) -> Any:  # fmt: skip
    """alpha * d loss / d alpha in a row of pixels; light and what is behind go on behind the Gaussian."""
    behind = load(state, BEHIND + row) - weight * q
    store(state, BEHIND + row, behind)
    store(light, row, before - weight)
    d_alpha = before * q - behind * reciprocal(_ONE - alpha)
    return where(alpha < splat(_ALPHA_MAX), d_alpha * alpha)


@inlined
def pull_gradients(
    job: tuple[Any, ...], vectors: Vectors, light: Floats, falloff_y: Floats, i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Add the gradients of one Gaussian in a tile to its row of d_records, all but those of z and features unscaled.

    They are those of m = alpha * d loss / d alpha times 1, dx, dy, distance², column by column. The gradients of the
    image lie in the planes of `image`; of three features they stay in registers, of others they are walked over twice.
    """
    state, image, d_records, padded, noted = job[0], job[1], job[2], job[3], job[9]
    _, dx, dx2, center, _, z = pair
    first, last = box[2], box[3]
    used = len(image) // PIXELS
    pulled, pulled_y, pulled_y2, d_z = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
    if vectors is None:
        at = COLORS * i
        red, green, blue = padded[at], padded[at + 1], padded[at + 2]
        d_red, d_green, d_blue = splat(_ZERO), splat(_ZERO), splat(_ZERO)
        for y in range(first, last + 1):
            row = TILE * y
            dy = F32(y) + _HALF - center
            before = load(light, row)
            alpha = row_opacity(y, before, falloff_y, pair)
            weight = alpha * before
            d_depth, by_red = load(state, D_DEPTH + row), load(image, row)
            by_green, by_blue = load(image, PIXELS + row), load(image, 2 * PIXELS + row)
            q = by_red * red + by_green * green + by_blue * blue + d_depth * z + load(state, D_SEEN + row)
            m = pull_alpha(state, light, row, before, alpha, weight, q)
            pulled, pulled_y, pulled_y2 = pulled + m, pulled_y + m * dy, pulled_y2 + m * (dy * dy)
            d_z = d_z + weight * d_depth
            d_red, d_green, d_blue = d_red + weight * by_red, d_green + weight * by_green, d_blue + weight * by_blue
            store(state, WEIGHTS + row, weight)
        add_totals(d_records, 8 * i + 4, pulled, d_red, d_green, d_blue)
        add_totals(d_records, 8 * i, pulled * dx, pulled_y, pulled * dx2 + pulled_y2, d_z)
    else:
        at, size = 16 * len(vectors) * i, 8 + used
        for y in range(first, last + 1):
            row = TILE * y
            dy = F32(y) + _HALF - center
            before = load(light, row)
            alpha = row_opacity(y, before, falloff_y, pair)
            weight = alpha * before
            d_depth = load(state, D_DEPTH + row)
            q = d_depth * z + load(state, D_SEEN + row)
            for c in range(used):
                q = q + load(image, PIXELS * c + row) * padded[at + c]
            m = pull_alpha(state, light, row, before, alpha, weight, q)
            pulled, pulled_y, pulled_y2 = pulled + m, pulled_y + m * dy, pulled_y2 + m * (dy * dy)
            d_z = d_z + weight * d_depth
            store(state, WEIGHTS + row, weight)
        add_totals(d_records, size * i + 4, pulled, splat(_ZERO), splat(_ZERO), splat(_ZERO))
        add_totals(d_records, size * i, pulled * dx, pulled_y, pulled * dx2 + pulled_y2, d_z)
        for c in range(0, used, 4):
            a, b, d, e = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
            for row in range(TILE * first, TILE * last + TILE, TILE):
                weight, plane = load(state, WEIGHTS + row), PIXELS * c + row
                a, b = a + weight * load(image, plane), b + weight * load(image, plane + PIXELS)
                d, e = d + weight * load(image, plane + 2 * PIXELS), e + weight * load(image, plane + 3 * PIXELS)
            add_totals(d_records, size * i + 8 + c, a, b, d, e)
    if len(noted) > 0:
        note(state, noted, i, first, last)


@inner
def note(state: Floats, noted: Floats, i: int, first: int, last: int) -> None:
    """Note a Gaussian's largest weight in rows first..last of a tile, and add what it answers for."""
    most, answered = splat(_ZERO), splat(_ZERO)
    for row in range(TILE * first, TILE * last + TILE, TILE):
        weight = load(state, WEIGHTS + row)
        most, answered = maximum(most, weight * load(state, COUNT + row)), answered + weight * load(state, ERROR + row)
    noted[i, 0] = max(noted[i, 0], reduce_max(most))
    noted[i, 1] += total(answered)


@inner
def close_gradients(job: tuple[Any, ...], vectors: Vectors, light: Floats, tile: tuple[int, ...]) -> None:
    """Nothing is left to do in a tile: all is with the Gaussians."""


@fused_kernel
def backward_band(
    vectors: Vectors, band: int, own: Ints, first: Ints, slots: Longs, records: Floats, padded: Floats,
    tile_starts: Longs, members: Ints, features: Floats, planes: Floats, d_image: Floats, d_planes: Floats,
    d_geometry: Floats, d_features: Floats, shared: Floats, marks: Floats, noted: Floats, noted_apart: Floats,
) -> None:  # fmt: skip
    """Gradients of the Gaussians seen in a band: of u, v, sigma_px, z, opacity to d_geometry (5, M) and of the features
    to d_features (M, C), or, where other bands add to them too, to their row of `shared` (S, 5 + C); likewise `noted`.

    features and planes are the images of the forward pass, d_image and d_planes their gradients.
    """
    height, width, used = features.shape
    lanes_used = (used + 3) // 4 * 4  # features are summed up by fours
    size, features_at = (8, GEOMETRY) if vectors is None else (8 + lanes_used, 8)
    d_records = np.zeros(size * len(own), np.float32)
    image = np.zeros(PIXELS * (COLORS if vectors is None else lanes_used), np.float32)
    stats = np.zeros((len(own) if marks.size > 0 else 0, 2), np.float32)
    state = np.empty(PIXELS * PLANES, np.float32)
    job = (state, image, d_records, padded, features, planes, d_image, d_planes, marks, stats)
    visitors = (open_gradients, pull_gradients, close_gradients)
    walk_tiles(visitors, job, vectors, band, tile_starts, members, records, width, height)
    for k in range(len(own)):
        i, at = own[k], size * k
        sigma_px, opacity = records[RECORD * k + 2], records[RECORD * k + 4]
        precision = _ONE / (sigma_px * sigma_px)
        d_records[at] *= precision
        d_records[at + 1] *= precision
        d_records[at + 2] *= precision / sigma_px
        d_records[at + 4] /= opacity
        if slots[i + 1] > slots[i]:
            row = shared[slots[i] + band - first[i]]
            for j in range(GEOMETRY):
                row[j] = d_records[at + j]
            for c in range(used):
                row[GEOMETRY + c] = d_records[at + features_at + c]
            for j in range(2 if marks.size > 0 else 0):
                noted_apart[slots[i] + band - first[i], j] = stats[k, j]
        else:
            for j in range(GEOMETRY):
                d_geometry[j, i] = d_records[at + j]
            for c in range(used):
                d_features[i, c] = d_records[at + features_at + c]
            for j in range(2 if marks.size > 0 else 0):
                noted[i, j] = stats[k, j]


@fused_kernel
def sum_shared(
    start: int, rows: int, slots: Longs, shared: Floats, d_geometry: Floats, d_features: Floats,
) -> None:  # fmt: skip
    """The gradients of the Gaussians in several bands, of `rows` Gaussians from `start` on: the sums of what each of
    the bands has put into their rows of `shared`, always added in the same order."""
    for i in range(start, min(start + rows, len(slots) - 1)):
        if slots[i + 1] == slots[i]:
            continue
        first = shared[slots[i]]
        for k in range(slots[i] + 1, slots[i + 1]):
            for c in range(len(first)):
                first[c] += shared[k, c]
        for j in range(GEOMETRY):
            d_geometry[j, i] = first[j]
        for c in range(d_features.shape[1]):
            d_features[i, c] = first[GEOMETRY + c]
