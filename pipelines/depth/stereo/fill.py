"""Depth where the views do not agree: at each pixel the plane through the sure depths that lie along like colours.

Walls and cupboards without texture cannot be matched, but their borders can, and they are mostly flat. A chance match
in the middle of them stands alone, so that how sure a depth is depends on how sure those around it are.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .spread import spread_votes

Array = NDArray[np.float64]

SURE = 0.3
"""Confidence from which a depth is evidence and stays as it is."""
_COMPANY_REACH, _COMPANY_SD = 3 / 80, 30.0
"""As a part of the longer side; colours."""
_COMPANY_POWER = 0.9
"""Brings the calibration: from confidence 0.42 (reliability 0.5) on, at most 3 % are off by more than 5 %."""
_EVIDENCE_POWER = 2.5
_REACHES = ((1 / 16, 30.0, 1.0), (1 / 4, 60.0, 0.1))
"""How far a depth speaks along like colours (as a part of the longer side), the colour step that stops it, and how much
it then counts."""
_ANYWHERE, _ANYWHERE_REACH = 1e-5, 1 / 4
"""Weight and reach, as a part of the longer side, of what speaks across all colours: only where nothing else does. From
a fourth of it on, the blur (OpenCV cuts it off at four standard deviations) reaches from any pixel to any other."""
_RIDGE = 3e-4
"""Variance of place, in longer sides squared, below which the evidence does not fix a slope: then it is kept small."""
_LEAST_SLOPE, _MOST_SLOPE = 0.5, 1.6
_LEAST_PIXELS = 40
_FLAT_CONFIDENCE, _GUESS_CONFIDENCE = 0.2, 0.03
_KNOWN_MASS = 1e-3


def judge_by_company(confidence: NDArray[np.float32], image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) confidence that also counts how sure the pixels around are that have a like colour; image (h, w, 3)."""
    both = np.stack([confidence, np.ones_like(confidence)], axis=-1)
    total, mass = np.moveaxis(spread_votes(both, image, _COMPANY_REACH * max(confidence.shape), _COMPANY_SD), -1, 0)
    return np.power(confidence * np.clip(total / mass, 0, 1), _COMPANY_POWER).astype(np.float32)


def fill_unsure(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], image: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) depth and confidence with every unsure depth replaced by a guess of low confidence; image (h, w, 3)."""
    sure = (confidence >= SURE) & (depth > 0)
    if sure.sum() < _LEAST_PIXELS:
        return depth, np.minimum(confidence, SURE)
    weight = np.where(depth > 0, confidence, 0).astype(np.float64) ** _EVIDENCE_POWER
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    guess, mass = _local_planes(inverse, weight, image)
    filled = np.where(sure, depth, 1 / guess)
    trust = np.maximum(_FLAT_CONFIDENCE * mass / (mass + _KNOWN_MASS), _GUESS_CONFIDENCE)
    return filled.astype(np.float32), np.where(sure, confidence, trust).astype(np.float32)


def _local_planes(inverse: Array, weight: Array, image: NDArray[np.uint8]) -> tuple[Array, Array]:
    """(h, w) inverse depth of the plane through the evidence around each pixel (in a picture, the inverse depth of a
    plane is linear), and the evidence's mass: weighted least squares whose weights fade along like colours."""
    height, width = inverse.shape
    side = max(height, width)
    y, x = np.mgrid[:height, :width] / side
    one = np.ones_like(x)
    factors = ((one, one), (x, one), (y, one), (x, x), (x, y), (y, y), (inverse, one), (inverse, x), (inverse, y))
    votes, sums = np.empty((height, width, len(factors)), np.float32), np.zeros((height, width, len(factors)))
    for k, (a, b) in enumerate(factors):
        votes[..., k] = weight * (a * b)
    for reach, color_sd, share in _REACHES:
        spread = spread_votes(votes, image, reach * side, color_sd)
        for k in range(len(factors)):  # one by one: all as float64 were the most memory that the stage needed
            sums[..., k] += share * spread[..., k].astype(np.float64)
    mass = sums[..., 0].copy()
    for k in range(len(factors)):
        sums[..., k] += _ANYWHERE * _spread_anywhere(votes[..., k]).astype(np.float64)
    total = np.maximum(sums[..., 0], 1e-30)
    sums[..., 1:] /= total[..., None]
    mx, my, xx, xy, yy, mean, xv, yv = np.moveaxis(sums[..., 1:], -1, 0)
    xx, yy, xy = xx - mx * mx + _RIDGE, yy - my * my + _RIDGE, xy - mx * my
    xv, yv = xv - mx * mean, yv - my * mean
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    plane = mean + slope_x * (x - mx) + slope_y * (y - my)
    return np.clip(plane, _LEAST_SLOPE * mean, _MOST_SLOPE * mean), mass


def _spread_anywhere(votes: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) votes blurred widely; at an eighth of the size, for it is smooth."""
    height, width = votes.shape
    size, sd = (max(1, width // 8), max(1, height // 8)), max(max(height, width) * _ANYWHERE_REACH / 8, 1.0)
    small = cv2.resize(votes, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sd, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
