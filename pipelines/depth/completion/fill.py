"""Support for a depth beside a keyframe's own match: other keyframes' sure depths, and planes through those around.

What a view shows at its rim, or too blank from where it stands, others may see better: their sure depths are borrowed
where both show the same colour. Walls and cupboards without texture cannot be matched at all, but their borders can,
and they are mostly flat: at each pixel the plane through the sure depths that lie along like colours. A chance match in
the middle of them stands alone, so that how sure a depth is depends on how sure those around it are.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel

_FAINT, _POWER = 5e-5, 0.25
"""Variance (intensities 0..1; two grey levels) and power by which agreement on a blank surface counts less."""
_COLOR_SD = 3.0
_LIGHT = 0.5
"""A difference in lightness counts so much: exposure and shading change it from view to view."""
_AGREE = 0.02
_IN_FRONT = 0.98

Array = NDArray[np.float64]

SURE = 0.3
"""Confidence from which a depth is evidence and stays as it is."""
_SMOOTH_REACH, _SMOOTH_SD = 3 / 80, 30.0
"""As a part of the longer side; colours."""
_SMOOTH_POWER = 0.9
"""Brings the calibration: from confidence 0.42 (reliability 0.5) on, at most 3 % are off by more than 5 %."""
_REACHES = ((1 / 16, 30.0, 1.0), (1 / 4, 60.0, 0.1))
"""How far a depth speaks along like colours (as a part of the longer side), the colour step that stops it, and how much
it then counts."""
_ANYWHERE, _ANYWHERE_REACH = 1e-5, 1 / 4
"""Weight and reach, as a part of the longer side, of what speaks across all colours: only where nothing else does. From
a fourth of it on, the blur (OpenCV cuts it off at four standard deviations) reaches from any pixel to any other."""
_RIDGE = 3e-4
"""Variance of place, in longer sides squared, below which the evidence does not fix a slope: then it is kept small."""
_MIN_SLOPE, _MAX_SLOPE = 0.5, 1.6
_FACTORS = 9
"""Sums that fix a plane, see `_write_votes`."""


def smooth_confidence(confidence: NDArray[np.float32], image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) confidence that also counts how sure the pixels around are that have a like colour; image (h, w, 3)."""
    both = np.stack([confidence, np.ones_like(confidence)], axis=-1)
    total, mass = np.moveaxis(domain_transform(both, image, _SMOOTH_REACH * max(confidence.shape), _SMOOTH_SD), -1, 0)
    return np.power(confidence * np.clip(total / mass, 0, 1), _SMOOTH_POWER).astype(np.float32)


def evidence_of(contrast: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) factor in [0, 1] of the confidence of a match, by the variance around it."""
    return np.power(contrast / (contrast + np.float32(_FAINT)), np.float32(_POWER))


def local_planes(inverse: Array, weight: Array, image: NDArray[np.uint8]) -> tuple[Array, Array]:
    """(h, w) inverse depth of the plane through the evidence around each pixel (in a picture, the inverse depth of a
    plane is linear), and the evidence's mass: weighted least squares whose weights fade along like colours."""
    side = max(inverse.shape)
    votes, sums = np.empty((*inverse.shape, _FACTORS), np.float32), np.zeros((*inverse.shape, _FACTORS))
    _write_votes(inverse, weight, side, votes)
    for reach, color_sd, share in _REACHES:
        _add(share, domain_transform(votes, image, reach * side, color_sd), sums)
    mass = sums[..., 0].copy()
    for k in range(_FACTORS):
        votes[..., k] = _spread_anywhere(votes[..., k])
    _add(_ANYWHERE, votes, sums)
    _fit_planes(sums, side, guess := np.empty_like(inverse))
    return guess, mass


@kernel
def _write_votes(inverse: Array, weight: Array, side: int, votes: NDArray[np.float32]) -> None:
    """What each pixel says of the plane: its weight times 1, x, y, x², xy, y², v, vx and vy, v the inverse depth."""
    for row in range(inverse.shape[0]):
        for column in range(inverse.shape[1]):
            x, y, v, w, out = column / side, row / side, inverse[row, column], weight[row, column], votes[row, column]
            out[0], out[1], out[2] = w, w * x, w * y
            out[3], out[4], out[5] = w * (x * x), w * (x * y), w * (y * y)
            out[6], out[7], out[8] = w * v, w * (v * x), w * (v * y)


@kernel
def _add(share: float, votes: NDArray[np.float32], sums: Array) -> None:
    """Add a share of float32 numbers to float64 ones, without a copy of either."""
    flat, into = votes.reshape(-1), sums.reshape(-1)
    for i in range(len(flat)):
        into[i] += share * np.float64(flat[i])


@kernel
def _fit_planes(sums: Array, side: int, guess: Array) -> None:
    """The inverse depth (h, w) of the plane of each pixel's sums (h, w, 9), those of `_write_votes`."""
    for row in range(sums.shape[0]):
        for column in range(sums.shape[1]):
            own = sums[row, column]
            total = max(own[0], 1e-30)
            mx, my, mean = own[1] / total, own[2] / total, own[6] / total
            xx = own[3] / total - mx * mx + _RIDGE
            yy = own[5] / total - my * my + _RIDGE
            xy = own[4] / total - mx * my
            xv, yv = own[7] / total - mx * mean, own[8] / total - my * mean
            determinant = xx * yy - xy * xy
            slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
            plane = mean + slope_x * (column / side - mx) + slope_y * (row / side - my)
            guess[row, column] = min(max(plane, _MIN_SLOPE * mean), _MAX_SLOPE * mean)


def _spread_anywhere(votes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) votes blurred widely; at an eighth of the size, for it is smooth."""
    height, width = votes.shape
    size, sd = (max(1, width // 8), max(1, height // 8)), max(max(height, width) * _ANYWHERE_REACH / 8, 1.0)
    small = cv2.resize(votes, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sd, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def agreed_depth(
    carried: list[tuple[NDArray[np.float32], NDArray[np.float32]]], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) mean of the carried depths that most likeness agrees on, and the sum of that likeness; 0 where it is not
    wanted (h, w)."""
    depths, likeness = (np.stack(part) for part in zip(*carried, strict=True))
    return _agree(depths, likeness, wanted)


def carry_depth(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    lab: NDArray[np.float32],
    warp: NDArray[np.float64],
    target: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The sure depths of another view as this one would see them (0 where none), and how alike the colours are.

    `warp` (3, 4) leads from the other view's pixels to this view's; `lab` and `target` (h, w, 3) are their pictures.
    """
    carried = np.zeros(depth.shape, np.float32)
    apart = np.zeros(depth.shape, np.float32)
    _splat(depth, confidence, lab, warp, target, carried, apart)
    return carried, np.where(carried > 0, np.exp(-apart / (2 * _COLOR_SD**2)), 0).astype(np.float32)


@kernel
def _splat(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    lab: NDArray[np.float32],
    warp: NDArray[np.float64],
    target: NDArray[np.float32],
    carried: NDArray[np.float32],
    apart: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z <= 0 or confidence[y, x] < SURE:
                continue
            u, v = x + 0.5, y + 0.5
            qx = z * (warp[0, 0] * u + warp[0, 1] * v + warp[0, 2]) + warp[0, 3]
            qy = z * (warp[1, 0] * u + warp[1, 1] * v + warp[1, 2]) + warp[1, 3]
            qz = z * (warp[2, 0] * u + warp[2, 1] * v + warp[2, 2]) + warp[2, 3]
            if qz <= 0:
                continue
            left, top = np.floor(qx / qz - 0.5), np.floor(qy / qz - 0.5)
            # Four pixels, so that a view from farther off leaves no holes; the nearest depth wins.
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    before = carried[row, column]
                    if before == 0 or qz < before * _IN_FRONT:
                        carried[row, column] = qz
                        lightness = target[row, column, 0] - lab[y, x, 0]
                        red = target[row, column, 1] - lab[y, x, 1]
                        yellow = target[row, column, 2] - lab[y, x, 2]
                        apart[row, column] = _LIGHT * lightness**2 + red**2 + yellow**2


@kernel
def _agree(
    lent: NDArray[np.float32], likeness: NDArray[np.float32], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    views, height, width = lent.shape
    found = np.zeros((height, width), np.float32)
    mass = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if not wanted[y, x]:
                continue
            for a in range(views):
                z = lent[a, y, x]
                if z <= 0:
                    continue
                total = 0.0
                inverse = 0.0
                for b in range(views):
                    other = lent[b, y, x]
                    if other > 0 and abs(other - z) < _AGREE * z:
                        total += likeness[b, y, x]
                        inverse += likeness[b, y, x] / other
                if total > mass[y, x] and inverse > 0:
                    mass[y, x] = total
                    found[y, x] = total / inverse
    return found, mass


def domain_transform(
    votes: NDArray[np.float32], image: NDArray[np.uint8], reach: float, color_sd: float
) -> NDArray[np.float32]:
    """(h, w, C) votes smoothed along the image (h, w, 3) by the domain transform (Gastal and Oliveira, SIGGRAPH 2011):
    a vote fades over `reach` pixels of like colour, and faster where the colour changes by about `color_sd`."""
    out = np.array(votes, np.float32, order="C")
    domain_transform_in_place(out, image, reach, color_sd)
    return out


def domain_transform_in_place(
    votes: NDArray[np.float32], image: NDArray[np.uint8], reach: float, color_sd: float
) -> None:
    """Do what `domain_transform` does to votes that nobody else has, without a second copy of all classes."""
    across, down = (_color_steps(image, axis) for axis in (1, 0))
    for iteration in range(2):
        fade = np.exp(-np.sqrt(2.0) / (reach * 0.5**iteration))
        _pass_rows(votes, _fading(across, 1, fade, reach / color_sd))
        _pass_columns(votes, _fading(down, 0, fade, reach / color_sd))


def _color_steps(image: NDArray[np.uint8], axis: int) -> NDArray[np.float32]:
    """Colour steps along an axis, one fewer than there are pixels: differences of the three channels, summed."""
    first, second = (image[:, :-1], image[:, 1:]) if axis == 1 else (image[:-1], image[1:])
    red, green, blue = cv2.split(cv2.absdiff(first, second))
    return red.astype(np.float32) + green + blue


def _fading(steps: NDArray[np.float32], axis: int, fade: float, stretch: float) -> NDArray[np.float32]:
    """(h, w) how much of a vote is left after the colour step from the pixel before along the axis; the first are 0."""
    left = np.power(np.float32(fade), 1 + np.float32(stretch) * steps)
    return np.asarray(np.insert(left, 0, 0, axis=axis), np.float32)


@kernel
def _pass_rows(votes: NDArray[np.float32], fading: NDArray[np.float32]) -> None:
    height, width, classes = votes.shape
    for y in range(height):
        for x in range(1, width):
            for c in range(classes):
                votes[y, x, c] += fading[y, x] * (votes[y, x - 1, c] - votes[y, x, c])
        for x in range(width - 2, -1, -1):
            for c in range(classes):
                votes[y, x, c] += fading[y, x + 1] * (votes[y, x + 1, c] - votes[y, x, c])


@kernel
def _pass_columns(votes: NDArray[np.float32], fading: NDArray[np.float32]) -> None:
    height, width, classes = votes.shape
    for y in range(1, height):
        for x in range(width):
            for c in range(classes):
                votes[y, x, c] += fading[y, x] * (votes[y - 1, x, c] - votes[y, x, c])
    for y in range(height - 2, -1, -1):
        for x in range(width):
            for c in range(classes):
                votes[y, x, c] += fading[y + 1, x] * (votes[y + 1, x, c] - votes[y, x, c])
