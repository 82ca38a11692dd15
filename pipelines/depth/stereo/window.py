"""The window by which two views are compared: pixels count by how like the middle they are.

A plain square that reaches over the border of an object is matched by that border, so the object grows by half a
window into whatever lies behind it. With weights by colour (Yoon and Kweon, PAMI 2006) a pixel is compared by its own
surface. The weights fall off as a Gaussian and not as an exponential: the contrast of a border is so much larger than
the texture of a wall that a thousandth of the weight still decides the correlation.

All that correlates is part of one kernel and takes sixteen pixels at once: rows lie in flat arrays, `row_length` apart.
"""

import numpy as np
from numpy.typing import NDArray

from ...providers import DepthEstimate
from ...system.jit import kernel
from ...system.lanes import iota, lane_exp, load, maximum, min_scalar, splat, store, where
from ...system.threads import fused_kernel, inner
from .lane_sampling import choose, interpolate, smallest, square_root
from .volume import BAND_ROWS

RADIUS = 3
STEP = 2
SIDE = 4
"""Every second pixel of 7 x 7, from -RADIUS to RADIUS: as good as all of them, at a third of the time."""
LIKENESS = 0.04
"""How unlike a pixel may be and still count, of intensities 0..1: more than the texture of most surfaces, less than the
step from one to the next."""
VARIANCE_FLOOR = 2e-5
"""Added to both variances (intensities 0..1): below about one grey level there is no texture, only noise."""
OUTSIDE = -2.0
"""Marks the score of a view that does not see the pixel."""
SAMPLED_ROWS = BAND_ROWS + 2 * RADIUS
"""Of another view, for a band."""

_LANES = 16
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_NEAR, _FLOOR, _OUTSIDE = np.float32(1e-6), np.float32(VARIANCE_FLOOR), np.float32(OUTSIDE)


@inner
def row_length(width: int) -> int:
    """Numbers between the starts of two rows: whole vectors, one more than the image has, for the border."""
    return (width + _LANES - 1) // _LANES * _LANES + _LANES


@inner
def pad_rows(image: NDArray[np.float32], first: int, last: int) -> NDArray[np.float32]:
    """Rows first..last of the image (H, W) and RADIUS more on all sides, the border repeated, flat and `row_length`
    apart; the first row's first pixel lies RADIUS rows and columns in."""
    height, width = image.shape
    length = row_length(width)
    rows = np.empty((last - first + 2 * RADIUS, length), np.float32)
    for k in range(len(rows)):
        y = min(max(first + k - RADIUS, 0), height - 1)
        for x in range(length):
            rows[k, x] = image[y, min(max(x - RADIUS, 0), width - 1)]
    return rows.reshape(-1)


@inner
def weigh_windows(
    rows: NDArray[np.float32], length: int, likeness: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of `pad_rows`, `length` apart: the windows' weights, flat (rows, SIDE, SIDE, row length) with sums of one window
    1, and their mean and variance, flat (rows, 2, row length).

    likeness: standard deviation of the weights, a difference in intensity.
    """
    count, taps = len(rows) // length - 2 * RADIUS, SIDE * SIDE
    weights, moments = np.empty(count * taps * length, np.float32), np.empty(count * 2 * length, np.float32)
    narrow = splat(np.float32(-0.5 / likeness**2))
    # The middle is no part of the window; the floor keeps a lone bright pixel from dividing by nothing.
    floor = splat(np.float32(1e-6))
    for k in range(count):
        for x in range(0, length - _LANES, _LANES):
            middle = load(rows, (k + RADIUS) * length + x + RADIUS)
            total, mean, square = splat(_ZERO), splat(_ZERO), splat(_ZERO)
            own = k * taps * length + x
            for j in range(SIDE):
                for i in range(SIDE):
                    value = load(rows, (k + j * STEP) * length + i * STEP + x)
                    off = value - middle
                    weight = lane_exp(off * off * narrow) + floor
                    store(weights, own + (j * SIDE + i) * length, weight)
                    total, mean, square = total + weight, mean + weight * value, square + weight * value * value
            share = splat(_ONE) / total
            for tap in range(taps):
                store(weights, own + tap * length, load(weights, own + tap * length) * share)
            mean = mean * share
            store(moments, 2 * k * length + x, mean)
            store(moments, (2 * k + 1) * length + x, maximum(square * share - mean * mean, splat(_ZERO)))
    return weights, moments


@inner(makes_arrays=False)
def need_around(tiles: NDArray[np.bool_], needed: NDArray[np.bool_]) -> bool:
    """Which vectors of a row are to be sampled, so that the windows of those `tiles` are whole; whether any is."""
    needed[:] = False
    for t in range(len(tiles)):
        if tiles[t]:
            needed[t], needed[t + 1] = True, True
    return bool(needed.any())


@inner(makes_arrays=False)
def warp_row(
    other: NDArray[np.float32],
    columns: int,
    rows: int,
    warp: NDArray[np.float64],
    inverse_depths: NDArray[np.float32],
    offset: float,
    y: int,
    width: int,
    needed: NDArray[np.bool_],
    samples: NDArray[np.float32],
    seen: NDArray[np.float32],
    at: int,
) -> None:
    """Samples of the picture `other` (rows, columns), flat as of `with_row_below`, for row y of the reference, with the
    border repeated, its pixels of inverse depths (row length,), the first RADIUS in, plus `offset`, into `samples` from
    `at` on; likewise into `seen` 1 or 0, whether they lie in the other view. Vectors that are not `needed` are left as
    they were."""
    v = y + 0.5
    bx = np.float32(warp[0, 1] * v + warp[0, 2])
    by = np.float32(warp[1, 1] * v + warp[1, 2])
    bz = np.float32(warp[2, 1] * v + warp[2, 2])
    ax, ay, az = np.float32(warp[0, 0]), np.float32(warp[1, 0]), np.float32(warp[2, 0])
    tx, ty, tz = np.float32(warp[0, 3]), np.float32(warp[1, 3]), np.float32(warp[2, 3])
    right, bottom = np.float32(columns - 1.001), np.float32(rows - 1.001)
    for block in range(len(needed)):
        if not needed[block]:
            continue
        x = block * _LANES
        w, u = load(inverse_depths, x) + np.float32(offset), iota(np.float32(x - RADIUS) + _HALF)
        u = min_scalar(maximum(u, splat(_HALF)), np.float32(width) - _HALF)
        z = u * az + bz + w * tz
        scale = _ONE / maximum(z, splat(_NEAR))
        across = (u * ax + bx + w * tx) * scale - _HALF
        down = (u * ay + by + w * ty) * scale - _HALF
        inside = (z > _NEAR) & (across >= -_HALF) & (down >= -_HALF)
        inside = inside & (across <= right + _HALF) & (down <= bottom + _HALF)
        store(seen, at + x, where(inside, splat(_ONE)))
        across, down = min_scalar(maximum(across, splat(_ZERO)), right), min_scalar(maximum(down, splat(_ZERO)), bottom)
        store(samples, at + x, interpolate(other, columns, across, down))


@inner(makes_arrays=False)
def correlate(
    samples: NDArray[np.float32],
    seen: NDArray[np.float32],
    weights: NDArray[np.float32],
    reference: NDArray[np.float32],
    moments: NDArray[np.float32],
    length: int,
    start: int,
    k: int,
    x: int,
) -> object:
    """The weighted correlations of the windows of sixteen pixels, in row k of the band from x on, with the samples of
    another view from `start` on; OUTSIDE where that does not see them or a sample is NaN. reference: `pad_rows`."""
    total, square, product = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    own = k * SIDE * SIDE * length + x
    for j in range(SIDE):
        for i in range(SIDE):
            tap = (k + j * STEP) * length + i * STEP + x
            value = load(samples, start + tap)
            part = load(weights, own + (j * SIDE + i) * length) * value
            total, square, product = total + part, square + part * value, product + part * load(reference, tap)
    variance = maximum(square - total * total, splat(_ZERO))
    covariance = product - total * load(moments, 2 * k * length + x)
    value = covariance / square_root((variance + _FLOOR) * (load(moments, (2 * k + 1) * length + x) + _FLOOR))
    # Samples of what is no scene are NaN, and so is what is made of them: it compares with nothing.
    known = (value > _OUTSIDE) & (load(seen, start + (k + RADIUS) * length + x + RADIUS) > _ZERO)
    return choose(known, value, splat(_OUTSIDE))


@inner(makes_arrays=False)
def best_mean(
    samples: NDArray[np.float32],
    seen: NDArray[np.float32],
    weights: NDArray[np.float32],
    reference: NDArray[np.float32],
    moments: NDArray[np.float32],
    length: int,
    views: int,
    k: int,
    x: int,
    top: NDArray[np.float32],
) -> object:
    """Of sixteen pixels, in row k of the band from x on, the mean of the largest correlations among the views that see
    them; 0 where none does. As many count as `top` has room for, sixteen numbers each."""
    for b in range(0, len(top), _LANES):
        store(top, b, splat(_OUTSIDE))
    for n in range(views):
        score = correlate(samples, seen, weights, reference, moments, length, n * SAMPLED_ROWS * length, k, x)
        for b in range(0, len(top), _LANES):
            before = load(top, b)
            store(top, b, maximum(before, score))
            score = smallest(before, score)
    total, used = splat(_ZERO), splat(_ZERO)
    for b in range(0, len(top), _LANES):
        score = load(top, b)
        total = total + where(score > _OUTSIDE, score)
        used = used + where(score > _OUTSIDE, splat(_ONE))
    return total / maximum(used, splat(_ONE))


@fused_kernel
def surface_contrast(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) variance of the intensities (0..1) of each pixel's window, which count by how like the pixel they are: of
    a blank surface it is small also beside its border."""
    height, width = image.shape
    length, contrast = row_length(width), np.empty((height, width), np.float32)
    for y in range(height):
        contrast[y] = weigh_windows(pad_rows(image, y, y + 1), length, LIKENESS)[1][length : length + width]
    return contrast


_COLOR_SD = 10.0
_SURFACE = 0.05


def upsample_depth(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], image: NDArray[np.uint8]
) -> DepthEstimate:
    """(h, w) depth and confidence to the size of the image (H, W, 3).

    Each pixel joins the coarse neighbour whose colour is most like its own (a selection: depth is never averaged
    across an edge), then interpolates among the neighbours on that one's surface.
    """
    height, width = image.shape[:2]
    if depth.shape == (height, width):
        return DepthEstimate(depth, confidence)
    coarse = _coarse_colors(image, depth.shape[0], depth.shape[1])
    out_depth = np.empty((height, width), np.float32)
    out_confidence = np.empty((height, width), np.float32)
    _upsample(depth, confidence, image, coarse, out_depth, out_confidence)
    return DepthEstimate(out_depth, out_confidence)


def _coarse_colors(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.float32]:
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)


@kernel
def _upsample(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    image: NDArray[np.uint8],
    coarse: NDArray[np.float32],
    out_depth: NDArray[np.float32],
    out_confidence: NDArray[np.float32],
) -> None:
    rows, columns = depth.shape
    height, width = out_depth.shape
    for y in range(height):
        py = (y + 0.5) * rows / height - 0.5
        iy = int(np.floor(py))
        for x in range(width):
            px = (x + 0.5) * columns / width - 0.5
            ix = int(np.floor(px))
            best, at_y, at_x = -1.0, 0, 0
            for j in range(iy - 0, iy + 2):
                for i in range(ix - 0, ix + 2):
                    cy, cx = min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)
                    if depth[cy, cx] <= 0:
                        continue
                    difference = 0.0
                    for c in range(3):
                        difference += (np.float64(image[y, x, c]) - coarse[cy, cx, c]) ** 2
                    near = (1 - min(abs(py - j), 1.0)) * (1 - min(abs(px - i), 1.0))
                    weight = np.exp(-difference / (2 * _COLOR_SD * _COLOR_SD)) * (near + 0.05)
                    if weight > best:
                        best, at_y, at_x = weight, cy, cx
            if best < 0:
                out_depth[y, x] = 0
                out_confidence[y, x] = 0
                continue
            reference = depth[at_y, at_x]
            total, inverse, sure = 0.0, 0.0, 0.0
            for j in range(iy, iy + 2):
                for i in range(ix, ix + 2):
                    cy, cx = min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)
                    d = depth[cy, cx]
                    if d <= 0 or abs(d - reference) > _SURFACE * reference:
                        continue
                    weight = (1 - min(abs(py - j), 1.0)) * (1 - min(abs(px - i), 1.0)) + 1e-3
                    total += weight
                    inverse += weight / d
                    sure += weight * confidence[cy, cx]
            out_depth[y, x] = total / inverse
            out_confidence[y, x] = sure / total
