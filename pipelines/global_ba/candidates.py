"""Which keyframes might show the same place again."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipelines.config import GlobalBaConfig
from pipelines.correspondence.retrieval import far_apart, loop_pairs
from pipelines.global_ba.semantics import LabelSummary, richness, similarity
from pipelines.types import SparseModel

Array = NDArray[np.float64]

SHARED_POINTS = 15
"""Keyframes with this many points in common need no loop."""
RICH = 0.9
"""Keyframes of a richness above this propose loops by semantics, eq. (21)."""
SIMILAR = 0.6
"""T_loop of eq. (23) on the similarity of eq. (24)."""
WEIGHTS = (0.4, 0.3, 0.3)
"""α₁ to α₃ of eq. (24): mean IoU, appearance, structure."""


def shared_points(model: SparseModel) -> NDArray[np.int64]:
    """(N, N): how many points two keyframes both see."""
    n, p = len(model.frame_ids), len(model.points_in_world)
    out = np.zeros((n, n), np.int64)
    order = np.argsort(model.obs_point, kind="stable")
    cams = model.obs_frame[order]
    bounds = np.searchsorted(model.obs_point[order], np.arange(p + 1))
    for first, last in pairwise(bounds):
        seen = cams[first:last]
        out[np.ix_(seen, seen)] += 1
    return out


def loop_candidates(
    model: SparseModel,
    looks: NDArray[np.float64],
    summaries: Sequence[LabelSummary],
    refused: Collection[tuple[int, int]],
    settings: GlobalBaConfig,
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of keyframe indices, sorted.

    Far apart in the sequence and hardly a point in common, and alike: by appearance (N, N), each keyframe's best; by
    semantics (eq. 23, 24) those of the rich keyframes (eq. 21) that pass T_loop. None of the pairs of frame ids that
    structure from motion has refused.
    """
    ids = model.frame_ids.tolist()
    unrelated = far_apart(len(ids), settings.loop_gap) & (shared_points(model) < SHARED_POINTS)
    alike = loop_pairs(looks - settings.loop_appearance, unrelated, settings.loop_candidates)
    by_labels = _semantic_candidates(unrelated, looks, summaries, settings) if settings.use_semantics else set()
    return sorted(pair for pair in {*alike, *by_labels} if (ids[pair[0]], ids[pair[1]]) not in refused)


def _semantic_candidates(
    unrelated: NDArray[np.bool_], looks: NDArray, summaries: Sequence[LabelSummary], settings: GlobalBaConfig
) -> set[tuple[int, int]]:
    out: set[tuple[int, int]] = set()
    for i in np.flatnonzero(richness(summaries) > RICH).tolist():
        others = np.flatnonzero(unrelated[i]).tolist()
        scores = [similarity(summaries[i], summaries[j], float(looks[i, j]), WEIGHTS) for j in others]
        for k in np.argsort(-np.array(scores), kind="stable")[: settings.loop_candidates]:
            if scores[k] > SIMILAR:
                out.add((min(i, others[k]), max(i, others[k])))
    return out
