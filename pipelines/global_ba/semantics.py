"""Label cues of keyframes: their semantic content, and the similarity of two of them (MSGS-SLAM eqs. 21-24)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..proxy.reliability import mean_iou
from ..types import VOID

Array = NDArray[np.float64]
GRID = (40, 30)


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
