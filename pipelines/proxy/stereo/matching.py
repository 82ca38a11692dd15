"""The depth of one keyframe from pictures of others: sweep, smoothing, refinement."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.stereo.bands import Bands
from msgs_slam.pipelines.proxy.stereo.refine import refine_inverse_depth
from msgs_slam.pipelines.proxy.stereo.smoothing import pick_planes, smooth_cost
from msgs_slam.pipelines.proxy.stereo.sweep import sweep_cost

LEAST_BEST, MOST_BEST = 3, 5
"""Of the views that one is matched with, the better half counts at a pixel, but not fewer or more than these."""
SMALL_STEP, JUMP, EDGE = 0.1, 1.2, 0.05
"""Of the smoothing: a plane more or less, any other step, and the intensity step that makes it cheap."""
STIFFNESS = 0.01
REACH, MOVE = 2, 1 / 3
"""Of the refinement: so many moves either way, of so much of the distance between planes."""
SOFT_SIZE, SOFT_PLACE, SOFT_VALUES = 7, 2.0, (1.0, 0.7)
"""Of the bilateral filters: pixels across, sd in pixels, and sd in distances between planes, before and after the
refinement."""


def match_planes(
    image: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    planes: NDArray[np.float64],
    bands: Bands,
) -> NDArray[np.float32]:
    """(H, W) inverse depth of the image (H, W) by others (N, H, W), found among the inverse depths `planes` (D,), which
    are evenly spaced, and refined; arguments as of `sweep_cost`."""
    step, best = planes[1] - planes[0], best_count(len(others))
    cost = sweep_cost(image, others, warps, planes, best, bands)
    total = smooth_cost(cost, image, SMALL_STEP, JUMP, EDGE, bands)
    inverse = (planes[0] + pick_planes(total) * step).astype(np.float32)
    inverse = cv2.bilateralFilter(inverse, SOFT_SIZE, SOFT_VALUES[0] * step, SOFT_PLACE)
    inverse = refine_inverse_depth(image, others, warps, inverse, MOVE * step, REACH, STIFFNESS, best, bands)
    return np.asarray(cv2.bilateralFilter(inverse, SOFT_SIZE, SOFT_VALUES[1] * step, SOFT_PLACE), np.float32)


def best_count(views: int) -> int:
    """Return how many of so many views count at a pixel: the others may not see it."""
    return min(MOST_BEST, max(LEAST_BEST, views // 2))
