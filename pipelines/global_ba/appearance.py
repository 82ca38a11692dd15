"""How keyframes look, as vectors whose products say how alike they are: VLAD over the run's own SIFT features.

It stands where the article has DINOv2 features, which need weights, and beside them where there are any: residuals of
RootSIFT descriptors to a small vocabulary learnt from the run itself, each word normalised (Jégou et al., PAMI 2012;
Arandjelović and Zisserman 2013).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]


def learn_vocabulary(descriptors: Float, words: int, seed: int, iterations: int = 10) -> Float:
    """(words, D) centres by k-means from descriptors (Q, D); fewer when there are fewer descriptors."""
    rng = np.random.default_rng(seed)
    centres = descriptors[np.sort(rng.permutation(len(descriptors))[:words])].copy()
    for _ in range(iterations):
        nearest = assign(descriptors, centres)
        for word in np.unique(nearest):
            centres[word] = descriptors[nearest == word].mean(0, dtype=np.float64)
    return centres


def assign(descriptors: Float, centres: Float) -> NDArray[np.int64]:
    """(Q,) index of the nearest centre."""
    distances = (centres**2).sum(1) - 2 * (descriptors @ centres.T)
    return np.asarray(distances.argmin(1), np.int64)


def vlad(descriptors: Float, centres: Float) -> Float:
    """(words * D,) unit vector of a picture's descriptors (Q, D); zero when it has none."""
    sums = np.zeros_like(centres)
    nearest = assign(descriptors, centres)
    for word in np.unique(nearest):
        sums[word] = (descriptors[nearest == word] - centres[word]).sum(0)
    # Each word counts the same, however much texture of its kind there is.
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
    flat = sums.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-6), np.float32)


def describe_keyframes(descriptors: Sequence[Float], words: int, seed: int) -> Float:
    """(N, words * D) VLAD vectors of the keyframes' descriptors."""
    pooled = np.concatenate([d[:: max(len(d) // 300, 1)] for d in descriptors])
    if len(pooled) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    centres = learn_vocabulary(pooled, words, seed)
    return _centred(np.array([vlad(d, centres) for d in descriptors]))


def join_appearances(own: Float, learned: Sequence[Float | None]) -> Float:
    """(N, D + F) unit vectors whose products are the mean of those of `own` (N, D) and of a network's (N of (F,)), the
    article's DINOSim; `own` alone unless the network has seen every keyframe."""
    vectors = [v for v in learned if v is not None]
    if len(vectors) < len(own) or not vectors:
        return own
    return np.concatenate([own, _centred(np.array(vectors))], 1) / np.sqrt(np.float32(2))


def _centred(vectors: Float) -> Float:
    """Unit vectors without their mean: what all keyframes of a room share says nothing of which are the same place."""
    vectors = vectors - vectors.mean(0)
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6), np.float32)
