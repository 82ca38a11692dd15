"""SIFT features of an image, and which keyframes may show the same place by a compact descriptor of them.

COLMAP's SIFT: OpenCV's takes 40 % of its time, and the path of all frames is as good on six recordings, but of a noisy
classroom half as far off again (tests/benchmarks/README.md). VLAD (Jégou et al., PAMI 2012) with intra-normalisation
(Arandjelović and Zisserman, All about VLAD, CVPR 2013) over a vocabulary learnt from the run itself.
"""

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

from ..types import Features, Vocabulary, require_shape

_of_thread = threading.local()


THRESHOLDS, _ENOUGH = (0.004, 0.001), 1 / 600
"""Contrast of the weakest feature, as a share of the range of grey: the second where the first finds fewer than so many
for a pixel. Of plain walls there are blotches beyond the noise then; where there is more to see they only add noise."""
_SUPPORT = 2.0
"""Of a feature's scale: nearer to a mask than this, what moves there affects its position."""


def sift_features(
    grey: NDArray[np.uint8],
    count: int,
    left_out: NDArray[np.bool_] | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
) -> Features:
    """SIFT features (Lowe 2004) of an (H, W) image, at most about `count`, as RootSIFT (Arandjelović and Zisserman,
    CVPR 2012).

    `thresholds` are tried until one finds enough. None is in the mask `left_out` (H, W), nor reaches into it.
    """
    require_shape("grey", grey, (None, None))
    for threshold in thresholds:
        keypoints, found = _extractor(count, threshold).extract_from_uint8_array(np.ascontiguousarray(grey))
        if len(keypoints) >= min(_ENOUGH * grey.size, count / 2):
            break
    if len(keypoints) == 0:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    features = Features(pycolmap.keypoints_to_matrix(keypoints), np.asarray(found.data, dtype=np.uint8))
    return features if left_out is None else clear_of(features, left_out)


def clear_of(features: Features, left_out: NDArray[np.bool_]) -> Features:
    """Keep the features of an image that neither lie in its mask (H, W) nor reach into it."""
    column, row = features.keypoints[:, :2].astype(np.int64).T
    away = cv2.distanceTransform((~left_out).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = away[row.clip(0, away.shape[0] - 1), column.clip(0, away.shape[1] - 1)]
    kept = distance > _SUPPORT * features.keypoints[:, 2]
    return Features(features.keypoints[kept], features.descriptors[kept])


def _extractor(count: int, threshold: float) -> pycolmap.FeatureExtractor:
    """One of a kind on each thread: the same image gives the same bytes."""
    made = vars(_of_thread).setdefault("made", {})
    if (count, threshold) not in made:
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.max_num_features = count
        options.sift.peak_threshold = threshold
        # A second orientation gives a second keypoint at the same place: it costs matching time and adds no geometry.
        options.sift.max_num_orientations = 1
        made[count, threshold] = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    return made[count, threshold]


# global descriptors --------------------------------------------------------------------------------------------

_WORDS = 64
_TRAINING_DESCRIPTORS = 20000
_ROUNDS = 12
_BLOCK = 256


def global_descriptor(features: Features, vocabulary: Vocabulary) -> NDArray[np.float32]:
    """(W * 128,) unit vector; products of two say how alike frames look, by chance 0. Zeros without features."""
    if len(features) == 0:
        return np.zeros(len(vocabulary.mean), np.float32)
    return unit(_vlad(features, vocabulary.words) - vocabulary.mean).astype(np.float32)


def compute_global_descriptors(
    all_features: Iterable[Features], count: int, vocabulary: Vocabulary
) -> NDArray[np.float32]:
    """(count, W * 128) of as many frames, one of which at a time is in memory."""
    descriptors = np.empty((count, len(vocabulary.mean)), np.float32)
    for row, features in zip(descriptors, all_features, strict=True):
        row[:] = global_descriptor(features, vocabulary)
    return descriptors


def learn_vocabulary(features: Sequence[Features], seed: int) -> Vocabulary:
    """Learn the words of these frames by k-means, and the mean of their descriptors."""
    rng = np.random.default_rng(seed)
    share = max(1, _TRAINING_DESCRIPTORS // max(1, len(features)))
    samples = [f.descriptors[rng.permutation(len(f))[:share]] for f in features]
    sample = np.concatenate([np.zeros((0, 128)), *samples])
    if len(sample) < _WORDS:
        return Vocabulary(np.zeros((1, 128)), np.zeros(128))
    start = np.unique(sample[rng.permutation(len(sample))[:_WORDS]], axis=0)
    words, _ = kmeans2(sample, start, iter=_ROUNDS, minit="matrix", missing="warn")
    total = np.zeros(words.size)
    for f in features:
        total += _vlad(f, words)
    return Vocabulary(words, total / len(features))


def _vlad(features: Features, words: NDArray[np.float64]) -> NDArray[np.float64]:
    total = np.zeros(words.shape)
    descriptors = features.descriptors[features.descriptors.any(1)].astype(np.float64)  # corners have none
    if len(descriptors):
        nearest, _ = vq(descriptors, words)
        for word in np.unique(nearest):
            total[word] = (descriptors[nearest == word] - words[word]).sum(0)
    # Each word counts the same, however much texture of its kind there is.
    return np.asarray(unit(unit(total).ravel()), np.float64)


def unit(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Normalise vectors (..., D) to length one; zeros stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class GlobalDescriptors:
    """Similarity of frames: the mean over kinds of descriptors, each unit vectors (N, D), of their products.

    Computed row by row: the similarity of every pair of a long recording does not fit into memory.
    """

    kinds: tuple[NDArray[np.float32], ...]

    def __len__(self) -> int:
        return len(self.kinds[0])

    def rows(self, part: slice) -> NDArray[np.float64]:
        """(R, N) of the frames `part` with all; rounded: the order in which a BLAS adds must not choose between
        pairs."""
        return np.mean([np.round(_products(v[part], v), 9) for v in self.kinds], axis=0)


def _products(some: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.float64]:
    """(R, N) in double precision, without a copy of all vectors in it."""
    rows, blocks = some.astype(np.float64), range(0, len(vectors), _BLOCK)
    return np.concatenate([rows @ vectors[i : i + _BLOCK].astype(np.float64).T for i in blocks], axis=1)


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Return all (i, j) with i < j <= i + overlap, and j = i + 2^k beyond it up to four times as far."""
    steps = list(range(1, overlap + 1))
    steps += [s for s in (overlap * 2, overlap * 4) if s > overlap]
    return [(i, i + s) for i in range(count) for s in steps if i + s < count]


def loop_pairs(
    descriptors: GlobalDescriptors, allowed: Callable[[slice], NDArray[np.bool_]], per_frame: int, least: float = 0.0
) -> list[tuple[int, int]]:
    """For each frame the `per_frame` most alike ones of those `allowed` (rows of (N, N)) that are more alike than
    `least`, as sorted unique (i, j), i < j.

    Of neighbouring candidates only the best is taken: five views of one place say less than five places.
    """
    pairs: set[tuple[int, int]] = set()
    for first in range(0, len(descriptors), _BLOCK):
        part = slice(first, min(first + _BLOCK, len(descriptors)))
        scores = np.where(allowed(part), descriptors.rows(part) - least, 0.0)
        for i, score in enumerate(scores, first):
            for _ in range(per_frame):
                j = int(np.argmax(score))
                if score[j] <= 0:
                    break
                pairs.add((min(i, j), max(i, j)))
                score[max(0, j - 1) : j + 2] = 0.0
    return sorted(pairs)


def far_apart(count: int, gap: int, places: int = 0) -> Callable[[slice], NDArray[np.bool_]]:
    """Rows of (N, N): which of `count` frames are at least `gap` places apart; of those that look in another direction,
    each direction with `places` frames, which are at another place."""
    index = np.arange(count)
    places = places or count

    def rows(part: slice) -> NDArray[np.bool_]:
        apart = np.abs(index[part, None] % places - index % places)
        return np.where(index[part, None] // places == index // places, apart >= gap, apart > 0)

    return rows
