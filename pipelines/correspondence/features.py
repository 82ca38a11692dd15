"""SIFT features of an image: the only extractor there is.

OpenCV's: COLMAP's takes two and a half times as long, for poses that are no better.
"""

from __future__ import annotations

import math
import threading

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.types import Features, require_shape

_of_thread = threading.local()

PEAK_THRESHOLD = 0.0025
"""Contrast of the weakest feature, as a share of the range of grey; lower finds more on plain walls. With 0.004 the
poses of a rendered office and a living room are 10 % worse, with 0.003 4 %."""
_LAYERS = 3
"""Of an octave; OpenCV divides the threshold by them."""
_SUPPORT = 2.0
"""Of a feature's scale: nearer to a mask than this, what moves there affects its position."""


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB -> (H, W) grey."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def extract_features(
    grey: NDArray[np.uint8],
    count: int,
    left_out: NDArray[np.bool_] | None = None,
    threshold: float = PEAK_THRESHOLD,
) -> Features:
    """SIFT features (Lowe 2004) of an (H, W) image, at most about `count`, as RootSIFT (Arandjelović and Zisserman,
    CVPR 2012).

    `threshold` is the least contrast. None is in the mask `left_out` (H, W), nor reaches into it.
    """
    require_shape("grey", grey, (None, None))
    found, descriptors = _extractor(threshold).detectAndCompute(np.ascontiguousarray(grey), None)
    if not found:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    # OpenCV puts the first pixel's centre at 0.
    rows = [(p.pt[0] + 0.5, p.pt[1] + 0.5, p.size / 2, math.radians(p.angle)) for p in found]
    table = np.array(rows, np.float32)
    chosen = _largest_places(table, count)
    table, descriptors = table[chosen], _root_sift(np.asarray(descriptors[chosen], np.float32))
    if left_out is not None:
        column, row = table[:, :2].astype(np.int64).T
        away = cv2.distanceTransform((~left_out).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        kept = away[row.clip(0, away.shape[0] - 1), column.clip(0, away.shape[1] - 1)] > _SUPPORT * table[:, 2]
        table, descriptors = table[kept], descriptors[kept]
    return Features(table, descriptors)


def _largest_places(table: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Rows of the features of largest scale. A second orientation gives a second one at the same place: it costs
    matching time and adds no geometry."""
    first = np.sort(np.unique(table[:, :3], axis=0, return_index=True)[1])
    return first[np.argsort(-table[first, 2], kind="stable")[:count]]


def _root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(F, 128) bytes of length 512."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-9))
    return np.clip(np.rint(Features.NORM * np.sqrt(descriptors / sums)), 0, 255).astype(np.uint8)


def _extractor(threshold: float) -> cv2.SIFT:
    """One on each thread: the same image gives the same bytes."""
    if getattr(_of_thread, "made", None) != threshold:
        _of_thread.extractor = cv2.SIFT.create(
            nfeatures=0,
            nOctaveLayers=_LAYERS,
            contrastThreshold=threshold * _LAYERS,
            edgeThreshold=10,
            sigma=1.6,
            descriptorType=cv2.CV_32F,
            enable_precise_upscale=True,
        )
        _of_thread.made = threshold
    return _of_thread.extractor
