"""Depths that a pixel without a sure match could have: what geometry says from along its row and column and around.

All are inverse depths: in a picture that of a plane is linear.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel
from .fill import SURE, local_planes

KINDS = (
    "fill", "own", "lent", "left", "right", "above", "below", "left line", "right line", "above line", "below line",
    "own around",
)  # fmt: skip
_EVIDENCE_POWER = 2.5
LENT_CONFIDENCE = np.float32(0.35)
"""Of what others lend."""
_FADE = 0.04
"""Of the image's longer side: over this length a sure depth's say in the line through it fades."""
_STEP = 0.04
"""Relative difference to the line at which another surface begins."""
_FLAT = 6.0
"""Squared pixels added to the spread of places: short lines are kept flat."""


Array = NDArray[np.float32]


@dataclass(frozen=True)
class Half:
    """A keyframe at half the size: inverse depth (0: none) and confidence (h, w) of the surest of four pixels, picture
    (h, w, 3) as RGB and in CIE Lab, and contrast as of `surface_contrast` (h, w)."""

    inverse: Array
    confidence: Array
    image: NDArray[np.uint8]
    lab: Array
    contrast: Array


def invert(values: Array) -> Array:
    """1 / values, and 0 stays 0: depth from inverse depth and back."""
    out = np.zeros_like(values)
    np.divide(1, values, out=out, where=values > 0)
    return out


@dataclass(frozen=True)
class Candidates:
    """Depths that P pixels (flat indices) could have, inverse (P, K), 0 where a kind says nothing; flat index of the
    sure pixel that speaks (P, K), the pixel itself where there is none; how much there is behind it (P, K)."""

    pixels: NDArray[np.int64]
    inverse: Array
    support: NDArray[np.int32]
    weight: Array


def find_candidates(own: Half, lent: Array, mass: Array, sure: NDArray[np.bool_]) -> Candidates:
    """List what the pixels of a keyframe that are not `sure` (h, w) could have, from those that are, by their own match
    or by the inverse depths lent by others (h, w), who agree as much as `mass` (h, w) says."""
    pixels = np.flatnonzero(~sure)
    spoken = np.where(sure & (own.confidence < SURE) | (own.confidence <= 0), lent, own.inverse)
    values = np.where(sure, spoken, np.float32(0)).astype(np.float32)
    inverse = np.zeros((len(KINDS), *sure.shape), np.float32)
    weight = np.zeros_like(inverse)
    support = np.tile(np.arange(sure.size, dtype=np.int32).reshape(sure.shape), (len(KINDS), 1, 1))
    trust = np.maximum(own.confidence, np.where(sure, LENT_CONFIDENCE, np.float32(0)))
    votes = np.where(spoken > 0, trust, 0).astype(np.float64) ** _EVIDENCE_POWER
    inverse[0], votes_there = local_planes(spoken.astype(np.float64), votes, own.image)
    weight[0], support[0] = np.minimum(1, np.log1p(1e3 * votes_there) / 8), _nearest(sure)
    inverse[1], weight[1] = own.inverse, own.confidence
    inverse[2], weight[2] = lent, np.minimum(mass / 4, 1)
    inverse[11], weight[11] = cv2.medianBlur(own.inverse, 5), cv2.medianBlur(own.confidence, 5)
    fade = math.exp(-1 / (_FADE * max(sure.shape)))
    _walk_lines(values, fade, inverse, weight, support)
    at = [np.ascontiguousarray(a.reshape(len(KINDS), -1)[:, pixels].T) for a in (inverse, weight)]
    return Candidates(pixels, at[0], np.ascontiguousarray(support.reshape(len(KINDS), -1)[:, pixels].T), at[1])


def _nearest(sure: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(h, w) flat index of the nearest sure pixel; 0 where there is none at all."""
    if not sure.any():
        return np.zeros(sure.shape, np.int32)
    _, label = cv2.distanceTransformWithLabels(
        (~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(label.max()) + 1, np.int32)
    place[label[sure]] = np.flatnonzero(sure)
    return np.asarray(place[label], np.int32)


@kernel
def _walk_lines(
    values: Array,
    fade: float,
    inverse: Array,
    weight: Array,
    support: NDArray[np.int32],
) -> None:
    """Along rows and columns both ways: the last sure value (kinds 3 to 6), and the line through those before it on the
    same surface (7 to 10)."""
    height, width = values.shape
    for way in range(4):
        upright = way >= 2
        lines, steps = (width, height) if upright else (height, width)
        for line in range(lines):
            n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
            last, place = 0.0, 0
            for step in range(steps):
                s = steps - 1 - step if way % 2 else step
                y, x = (s, line) if upright else (line, s)
                # Places are counted from the pixel where the walk is.
                sxx, sxy, sx = sxx - 2 * sx + n, sxy - sy, sx - n
                n, sx, sy, sxx, sxy = n * fade, sx * fade, sy * fade, sxx * fade, sxy * fade
                q = values[y, x]
                guess = 0.0
                if n > 0:
                    mx, my = sx / n, sy / n
                    slope = (sxy / n - mx * my) / (sxx / n - mx * mx + _FLAT)
                    guess = my - slope * mx
                if q > 0:
                    if n > 0 and abs(guess / q - 1) > _STEP:
                        n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
                    n, sy = n + 1, sy + q
                    last, place, guess = float(q), y * width + x, float(q)
                if last > 0:
                    inverse[3 + way, y, x], inverse[7 + way, y, x] = last, max(guess, 0.0)
                    weight[3 + way, y, x] = weight[7 + way, y, x] = min(n / 10, 1.0)
                    support[3 + way, y, x] = support[7 + way, y, x] = place
