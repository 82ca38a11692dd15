"""Which keyframes might show the same place again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..geometry.sparse_model import SparseModel
from ..proxy.maps import mean_iou
from ..sfm.features import GlobalDescriptors, far_apart, loop_pairs
from ..types import VOID, Array

GRID = (40, 30)

GAP = 8
"""A loop joins keyframes at least this many apart."""
SHARED_POINTS = 15
"""Keyframes with this many points in common need no loop."""
RICH = 0.9
"""Keyframes of a richness above this propose loops by semantics, eq. (21)."""
PER_KEYFRAME, MIN_ALIKE = 2, 0.02
"""Loops proposed by each keyframe's appearance, and the least appearance similarity of one."""
SIMILAR = 0.6
"""T_loop of eq. (23) on the similarity of eq. (24)."""
WEIGHTS = (0.4, 0.3, 0.3)
"""α₁ to α₃ of eq. (24): mean IoU, appearance, structure."""


def shared_points(model: SparseModel) -> csr_matrix:
    """(N, N): how many points two keyframes both see."""
    seen = model.seen.astype(np.int32)
    return (seen @ seen.T).tocsr()


def loop_candidates(
    model: SparseModel,
    looks: GlobalDescriptors,
    summaries: Sequence[LabelSummary],
    refused: Collection[tuple[int, int]],
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of keyframe indices, sorted.

    Far apart in the sequence and hardly a point in common, and alike: by appearance, each keyframe's best; by
    semantics (eq. 23, 24) those of the rich keyframes (eq. 21) that pass T_loop. None of the pairs of frame ids that
    structure from motion has refused.
    """
    ids = model.frame_ids.tolist()
    shared, apart = shared_points(model), far_apart(len(ids), GAP)

    def unrelated(part: slice) -> NDArray[np.bool_]:
        return apart(part) & (shared[part].toarray() < SHARED_POINTS)

    alike = loop_pairs(looks, unrelated, PER_KEYFRAME, MIN_ALIKE)
    by_labels = _semantic_candidates(unrelated, looks, summaries)
    return sorted(pair for pair in {*alike, *by_labels} if (ids[pair[0]], ids[pair[1]]) not in refused)


def _semantic_candidates(
    unrelated: Callable[[slice], NDArray[np.bool_]], looks: GlobalDescriptors, summaries: Sequence[LabelSummary]
) -> set[tuple[int, int]]:
    out: set[tuple[int, int]] = set()
    for i in np.flatnonzero(richness(summaries) > RICH).tolist():
        row = slice(i, i + 1)
        others = np.flatnonzero(unrelated(row)[0]).tolist()
        appearance = looks.rows(row)[0, others]
        scores = similarity(summaries[i], [summaries[j] for j in others], appearance, WEIGHTS, SIMILAR)
        for k in np.argsort(-scores, kind="stable")[:PER_KEYFRAME]:
            if scores[k] > SIMILAR:
                out.add((min(i, others[k]), max(i, others[k])))
    return out


@dataclass(frozen=True)
class LabelSummary:
    """labels (30, 40) uint8: the image's labels, sampled; entropy in nats; boundary: share of pixels on a boundary;
    graph (C, C): how much border each pair of classes shares (off the diagonal) and each class's area (on it)."""

    labels: NDArray[np.uint8]
    entropy: float
    boundary: float
    graph: Array


def summarise_labels(labels: NDArray[np.uint8], classes: int) -> LabelSummary:
    """The summary of a label image (H, W) with `classes` classes; VOID pixels count nowhere."""
    small = np.asarray(cv2.resize(labels, GRID, interpolation=cv2.INTER_NEAREST), np.uint8)
    known = small[small != VOID]
    share = np.bincount(known, minlength=classes)[:classes] / max(len(known), 1)
    entropy = float(-(share[share > 0] * np.log(share[share > 0])).sum())
    graph = np.diag(share)
    borders = 0
    for first, second in ((small[:, :-1], small[:, 1:]), (small[:-1], small[1:])):
        edge = (first != second) & (first != VOID) & (second != VOID)
        borders += int(edge.sum())
        np.add.at(graph, (first[edge], second[edge]), 1 / small.size)
        np.add.at(graph, (second[edge], first[edge]), 1 / small.size)
    return LabelSummary(small, entropy, borders / (2 * small.size), graph)


def richness(summaries: Sequence[LabelSummary], theta: float = 0.5) -> Array:
    """(N,) in 0..1: S = θ H + (1 - θ) E of eq. (22), entropy and boundary density as quantiles over the run.

    The result is again a quantile, so that S > 0.9 of eq. (21) means the top tenth. Ties share the higher rank.
    """

    def quantiles(values: Array) -> Array:
        return np.searchsorted(np.sort(values), values, side="right") / len(values)

    entropy = quantiles(np.array([s.entropy for s in summaries]))
    boundary = quantiles(np.array([s.boundary for s in summaries]))
    return quantiles(theta * entropy + (1 - theta) * boundary)


def structure_similarity(first: Array, others: Array) -> Array:
    """(K,) StructSim of eq. (24): cosine in 0..1 between the graph of regions (C, C) and others (K, C, C)."""
    norms = np.linalg.norm(first) * np.linalg.norm(others, axis=(1, 2))
    return np.asarray((first * others).sum((1, 2)) / np.where(norms > 0, norms, np.inf), np.float64)


def similarity(
    first: LabelSummary, others: Sequence[LabelSummary], appearance: Array, weights: tuple[float, ...], least: float
) -> Array:
    """(K,) Sim of eq. (24): α₁ mIoU + α₂ appearance + α₃ StructSim of one keyframe with others; 0 where it cannot be
    more than `least`."""
    if not others:
        return np.zeros(0)
    structure = structure_similarity(first.graph, np.stack([o.graph for o in others]))
    beside = weights[1] * appearance + weights[2] * structure
    may = np.flatnonzero(beside + weights[0] > least)
    out = np.zeros(len(others))
    if len(may):
        labels = np.stack([others[k].labels for k in may.tolist()])
        out[may] = beside[may] + weights[0] * mean_iou(first.labels, labels)
    return out
