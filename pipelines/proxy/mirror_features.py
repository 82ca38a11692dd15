"""Features of a picture that are the mirror image of other features of the same picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_MOST_FEATURES = 1500
_RATIO = 0.9


@dataclass(frozen=True)
class MirroredMatches:
    """xy (Q, 2, 2) pixels of the two features of each match; size (Q, 2) their diameters in pixels."""

    xy: NDArray[np.float64]
    size: NDArray[np.float64]


def mirrored_matches(image: NDArray[np.uint8]) -> MirroredMatches:
    """Features of an RGB image (h, w, 3) that look most like each other's mirror image, each match once."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=_MOST_FEATURES, contrastThreshold=0.015).detectAndCompute(
        grey, None
    )
    if len(keypoints) < 3:
        return MirroredMatches(np.zeros((0, 2, 2)), np.zeros((0, 2)))
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)).astype(np.float32)
    # Symmetric, because mirroring twice is nothing: the best partner's best partner is found in the same matrix.
    similarity = root @ mirror_descriptors(root).T
    xy = np.array([k.pt for k in keypoints]) + 0.5
    size = np.array([k.size for k in keypoints])
    # A symmetric blob is its own mirror image, and a second orientation gives a second feature at the same place.
    near = np.linalg.norm(xy[:, None] - xy[None], axis=-1) < 2 * np.maximum(size[:, None], size[None])
    similarity[near] = -1
    rows = np.arange(len(xy))
    best = similarity.argmax(1)
    value = similarity[rows, best]
    similarity[rows, best] = -1
    distinct = 2 - 2 * value < _RATIO**2 * (2 - 2 * similarity.max(1))
    keep = (best[best] == rows) & (rows < best) & (distinct | distinct[best]) & (value > 0)
    pair = np.stack([rows[keep], best[keep]], 1)
    return MirroredMatches(xy[pair], size[pair])


def mirror_descriptors(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(Q, 128) SIFT descriptors of the same features in the mirrored picture.

    A descriptor is 4 rows x 4 columns x 8 directions in a frame turned with the feature; mirroring at the feature's own
    direction turns the rows and the sense of the directions round.
    """
    bins = descriptors.reshape(-1, 4, 4, 8)[:, ::-1, :, (-np.arange(8)) % 8]
    return np.ascontiguousarray(bins.reshape(-1, 128))
