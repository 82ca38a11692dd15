"""SIFT features of a picture: the only extractor there is."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.types import Features, require_shape

_LAYERS = 3
_EDGE_RATIO = 10.0
_BLUR = 1.6


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB -> (H, W) grey."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def extract_features(
    grey: NDArray[np.uint8], count: int, threshold: float, left_out: NDArray[np.bool_] | None = None
) -> Features:
    """The `count` SIFT features (Lowe 2004) of most contrast of an (H, W) picture, as RootSIFT (Arandjelović and
    Zisserman, CVPR 2012), the strongest first.

    `threshold` is the least contrast, as a share of the range of grey. None lies in the mask `left_out` (H, W).
    """
    require_shape("grey", grey, (None, None))
    # OpenCV divides its threshold by the number of layers; its option puts keypoints a quarter pixel nearer the truth.
    # It chooses the strongest before it looks at a mask, and what is left out would crowd the others out.
    most = count if left_out is None else 0
    sift = cv2.SIFT.create(most, _LAYERS, _LAYERS * threshold, _EDGE_RATIO, _BLUR, cv2.CV_32F, True)
    found, descriptors = sift.detectAndCompute(grey, None if left_out is None else (~left_out).astype(np.uint8))
    if not found:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    table = np.array([(*k.pt, k.size, np.radians(k.angle), -k.response) for k in found], np.float64)
    # A second orientation gives a second keypoint at the same place: it costs matching time and adds no geometry.
    by_place = np.lexsort(table[:, 3::-1].T)
    _, first = np.unique(table[by_place, :3], axis=0, return_index=True)
    order = by_place[first[np.argsort(table[by_place[first], 4], kind="stable")]][:count]
    table[:, :2] += 0.5  # OpenCV puts the centre of the first pixel at (0, 0)
    return Features(table[order, :4].astype(np.float32), _root(np.asarray(descriptors, np.float32)[order]))


def _root(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The root of the L1-normalised descriptors, in bytes."""
    share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    return np.clip(np.round(np.sqrt(share) * Features.NORM), 0, 255).astype(np.uint8)
