"""The depth of one keyframe from images of others: sweep, smoothing, refinement, coarse and fine."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from .sweep import refine_inverse_depth, sweep_cost
from .volume import TILE, Bands, least_planes, pick_planes, smooth_cost, tiles_of

MIN_BEST, MAX_BEST = 3, 5
"""Of the views that one is matched with, the better half counts at a pixel, but not fewer or more than these."""
SMALL_STEP, JUMP, EDGE = 0.1, 1.2, 0.05
"""Of the smoothing: a plane more or less, any other step, and the intensity step that makes it cheap."""
STIFFNESS = 0.01
REACH, MOVE = 2, 1 / 3
"""Of the refinement: so many moves either way, of so much of the distance between planes."""
MARGIN, AROUND, CLEAR = 1, 1, 0.2
"""Of the whole size: planes on either side of a coarse one that are tried, coarse pixels around it that try it, and the
cost below which a match is clear by itself."""
LARGE = 200
"""Pixels on the shorter side: an image at half the size is halved again."""
COARSE = 2
"""Of half the size every second plane: there they are as far apart in pixels as all are in the whole size."""
SOFT_SIZE, SOFT_PLACE, SOFT_VALUES = 7, 2.0, (1.0, 0.7)
"""Of the bilateral filters: pixels across, sd in pixels, and sd in distances between planes, before and after the
refinement."""


class StereoImages(NamedTuple):
    """An image (H, W), others (N, H, W), intensities 0..1, and how they lie, (N, 3, 4) as of `warps_to`."""

    image: NDArray[np.float32]
    others: NDArray[np.float32]
    warps: NDArray[np.float64]

    def halved(self) -> StereoImages:
        """Return them at half the size."""
        height, width = self.image.shape
        columns, rows = max(width // 2, 1), max(height // 2, 1)
        small = [cv2.resize(x, (columns, rows), interpolation=cv2.INTER_AREA) for x in (self.image, *self.others)]
        down, up = np.diag([columns / width, rows / height, 1.0]), np.diag([width / columns, height / rows, 1.0, 1.0])
        return StereoImages(small[0], np.stack(small[1:]), down @ self.warps @ up)


def match_planes(images: StereoImages, planes: NDArray[np.float64], bands: Bands) -> NDArray[np.float32]:
    """(H, W) inverse depth of the image, found among the inverse depths `planes` (D,), which are evenly spaced, and
    refined.

    Planes are tried near those of a match at half the size own: a twelfth of them.
    """
    step, best = planes[1] - planes[0], best_count(len(images.others))
    cost = sweep_cost(*images, planes, best, bands, _planes_near(images, planes, SMALL_STEP, bands))
    total = smooth_cost(cost, images.image, SMALL_STEP, JUMP, EDGE, bands)
    inverse = (planes[0] + pick_planes(total) * step).astype(np.float32)
    inverse = cv2.bilateralFilter(inverse, SOFT_SIZE, SOFT_VALUES[0] * step, SOFT_PLACE)
    inverse = refine_inverse_depth(*images, inverse, MOVE * step, REACH, STIFFNESS, best, bands)
    return np.asarray(cv2.bilateralFilter(inverse, SOFT_SIZE, SOFT_VALUES[1] * step, SOFT_PLACE), np.float32)


def _planes_near(
    images: StereoImages, planes: NDArray[np.float64], small_step: float, bands: Bands
) -> NDArray[np.bool_]:
    """Which of the planes to try where, as of `planes_to_try`, by a match at half the size among every second of them,
    whose windows see twice as far over plain surfaces (Rothermel et al., SURE, LC3D 2012); and so on while that
    `is_large`."""
    small, few = images.halved(), planes[::COARSE]
    tried = _planes_near(small, few, COARSE * small_step, bands) if is_large(small) else None
    cost = sweep_cost(*small, few, best_count(len(images.others)), bands, tried)
    found = pick_planes(smooth_cost(cost, small.image, COARSE * small_step, JUMP, EDGE, bands))
    own, least = least_planes(cost)
    return planes_to_try(COARSE * found, COARSE * own, least, images.image.shape, len(planes))


def is_large(images: StereoImages) -> bool:
    """Whether a match of these is prepared by one at half the size."""
    return min(images.image.shape) >= LARGE


def planes_to_try(
    found: NDArray[np.float32],
    own: NDArray[np.int64],
    least: NDArray[np.float32],
    size: tuple[int, ...],
    planes: int,
) -> NDArray[np.bool_]:
    """(tiles down, tiles across, D) of an image of that size (H, W): the planes near those of a coarse match (h, w),
    in a tile and just beside it.

    `found` (h, w) are its planes, and those of least cost `own` (h, w) count where that `least` cost is clear: what
    is thin is smoothed away.
    """
    height, width = found.shape
    tried = np.zeros((*tiles_of(size[0], size[1]), planes), np.bool_)
    sure = least < CLEAR
    places = ((np.round(found).astype(np.int64), np.ones_like(sure)), (own, sure))
    rows, columns = np.mgrid[:height, :width]
    for down, across in product((-AROUND, 0, AROUND), repeat=2):
        row = np.clip(rows + down, 0, height - 1) * size[0] // height // TILE
        column = np.clip(columns + across, 0, width - 1) * size[1] // width // TILE
        for plane, known in places:
            tried[row[known], column[known], plane[known]] = True
    return np.asarray(maximum_filter1d(tried.view(np.uint8), 2 * MARGIN + 1, axis=2, mode="constant").view(np.bool_))


def best_count(views: int) -> int:
    """Return how many of so many views count at a pixel: the others may not see it."""
    return min(MAX_BEST, max(MIN_BEST, views // 2))
