"""Which keyframes may show the same place, by a compact descriptor of their features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from pipelines.correspondence.features import DESCRIPTOR_NORM, Features

_WORDS = 64
_TRAINING_DESCRIPTORS = 20000
_ROUNDS = 12


def frame_descriptors(features: Sequence[Features], seed: int) -> NDArray[np.float32]:
    """(N, D) unit vectors: aggregated residuals of the features to a vocabulary learnt from these frames alone.

    VLAD with intra-normalisation (Arandjelovic and Zisserman, All about VLAD, CVPR 2013). A frame without features
    gets zeros.
    """
    words = _vocabulary(features, np.random.default_rng(seed))
    return np.stack([_vlad(f.descriptors, words) for f in features])


def _vocabulary(features: Sequence[Features], rng: np.random.Generator) -> NDArray[np.float32]:
    share = max(1, _TRAINING_DESCRIPTORS // max(1, len(features)))
    samples = [f.descriptors[rng.permutation(len(f))[:share]] for f in features]
    sample = np.concatenate(samples).astype(np.float32) / DESCRIPTOR_NORM
    if len(sample) == 0:
        return np.zeros((1, 128), np.float32)
    words = sample[rng.permutation(len(sample))[:_WORDS]]
    for _ in range(_ROUNDS):
        nearest = _nearest_word(sample, words)
        counts = np.bincount(nearest, minlength=len(words))
        sums = _sum_by_word(sample, nearest, len(words))
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
    return words.astype(np.float32)


def _nearest_word(descriptors: NDArray[np.floating], words: NDArray[np.floating]) -> NDArray[np.int64]:
    # float64 and rounding: which BLAS kernel adds in which order must not decide between two near-equal words.
    score = descriptors.astype(np.float64) @ words.T.astype(np.float64) - (words.astype(np.float64) ** 2).sum(1) / 2
    return np.argmax(np.round(score, 9), axis=1)


def _sum_by_word(vectors: NDArray[np.floating], word: NDArray[np.int64], words: int) -> NDArray[np.float64]:
    members = csr_matrix((np.ones(len(word)), (word, np.arange(len(word)))), shape=(words, len(word)))
    return np.asarray(members @ vectors.astype(np.float64))


def _vlad(descriptors: NDArray[np.uint8], words: NDArray[np.float32]) -> NDArray[np.float32]:
    scaled = descriptors.astype(np.float32) / DESCRIPTOR_NORM
    total = np.zeros(words.shape, np.float64)
    if len(scaled):
        nearest = _nearest_word(scaled, words)
        total = _sum_by_word(scaled - words[nearest], nearest, len(words))
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    flat = total.ravel()
    return (flat / max(float(np.linalg.norm(flat)), 1e-12)).astype(np.float32)


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """All (i, j) with i < j <= i + overlap, and j = i + 2^k beyond it up to four times as far."""
    steps = list(range(1, overlap + 1))
    steps += [s for s in (overlap * 2, overlap * 4) if s > overlap]
    return [(i, i + s) for i in range(count) for s in steps if i + s < count]


def loop_pairs(descriptors: NDArray[np.float32], per_frame: int, min_gap: int) -> list[tuple[int, int]]:
    """For each frame the `per_frame` most alike ones at least `min_gap` away, as sorted unique (i, j), i < j.

    Of neighbouring candidates only the best is taken: five views of one place tell less than five places.
    """
    similarity = np.round(descriptors.astype(np.float64) @ descriptors.T.astype(np.float64), 9)
    pairs: set[tuple[int, int]] = set()
    index = np.arange(len(descriptors))
    for i in range(len(descriptors)):
        score = np.where(np.abs(index - i) >= min_gap, similarity[i], -1.0)
        for _ in range(per_frame):
            j = int(np.argmax(score))
            if score[j] <= 0:
                break
            pairs.add((min(i, j), max(i, j)))
            score[max(0, j - 1) : j + 2] = -1.0
    return sorted(pairs)
