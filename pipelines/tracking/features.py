"""Features that survive a jump: SIFT for matching, a small picture for finding the frames worth matching."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Features:
    """Keypoints (Q, 2) in pixels and their RootSIFT descriptors (Q, 128) float32, of unit length."""

    xy: Array
    descriptors: NDArray[np.float32]


def extract_features(grey: NDArray[np.uint8], count: int = 2000, left_out: NDArray[np.bool_] | None = None) -> Features:
    """The strongest `count` SIFT features (Lowe 2004), as RootSIFT (Arandjelović and Zisserman 2012), none of them
    in a mask (H, W)."""
    scene = None if left_out is None else (~left_out).astype(np.uint8)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=count, contrastThreshold=0.015).detectAndCompute(grey, scene)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    normalised = np.asarray(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12), np.float32)
    xy = np.array([k.pt for k in keypoints], dtype=np.float64) + 0.5
    return Features(xy, np.sqrt(normalised).astype(np.float32))


def match_features(first: Features, second: Features, ratio: float = 0.85) -> NDArray[np.int64]:
    """(Q, 2) index pairs that are each other's nearest and pass the ratio test in the first's direction."""
    if len(first.xy) < 2 or len(second.xy) < 2:
        return np.zeros((0, 2), np.int64)
    similarity: NDArray[np.float32] = np.asarray(first.descriptors @ second.descriptors.T, np.float32)
    best = np.asarray(similarity.argmax(1))
    rows = np.arange(len(best))
    best_value = similarity[rows, best]
    mutual = similarity.argmax(0)[best] == rows
    similarity[rows, best] = -1
    # Unit vectors: squared distance = 2 - 2 cos.
    near, next_near = 2 - 2 * best_value, 2 - 2 * similarity.max(1)
    keep = mutual & (near < ratio**2 * next_near)
    return np.stack([rows[keep], best[keep]], 1).astype(np.int64)


def frame_descriptor(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(D,) unit vector that says how a frame looks: a small blurred picture, brightness and contrast taken out."""
    small = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32)
    blurred = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)
    centred = (blurred - blurred.mean((0, 1))).ravel()
    return (centred / max(float(np.linalg.norm(centred)), 1e-6)).astype(np.float32)
