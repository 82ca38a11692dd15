"""Features of a picture that are the mirror image of other features of the same picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.correspondence.retrieval import unit
from msgs_slam.pipelines.types import Features

_MOST_FEATURES = 1500
_RATIO = 0.9


@dataclass(frozen=True)
class MirroredMatches:
    """xy (Q, 2, 2) pixels of the two features of each match; size (Q, 2) their diameters in pixels."""

    xy: NDArray[np.float64]
    size: NDArray[np.float64]


def mirrored_matches(features: Features) -> MirroredMatches:
    """Features of a picture, the largest of them, that look most like each other's mirror image, each match once."""
    largest = np.argsort(-features.keypoints[:, 2], kind="stable")[:_MOST_FEATURES]
    descriptors, xy = features.descriptors[largest], features.xy[largest]
    size = 2 * features.keypoints[largest, 2].astype(np.float64)
    if len(xy) < 3:
        return MirroredMatches(np.zeros((0, 2, 2)), np.zeros((0, 2)))
    root = unit(descriptors.astype(np.float32))
    # Symmetric, because mirroring twice is nothing: the best partner's best partner is found in the same matrix.
    similarity = root @ mirror_descriptors(root).T
    # A symmetric blob is its own mirror image.
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
