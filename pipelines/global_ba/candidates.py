"""Which keyframes might show the same place again."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipelines.config import GlobalBaConfig
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
    model: SparseModel, appearance: NDArray[np.float32], summaries: Sequence[LabelSummary], settings: GlobalBaConfig
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of keyframe indices, most promising first.

    Far apart in the sequence and hardly a point in common, and alike: by appearance, each keyframe's best; by semantics
    (eq. 23, 24) those of the rich keyframes (eq. 21) that pass T_loop.
    """
    n = len(model.frame_ids)
    index = np.arange(n)
    apart = np.abs(index[:, None] - index[None]) >= settings.loop_gap
    unrelated = apart & (shared_points(model) < SHARED_POINTS)
    looks = np.where(unrelated, appearance @ appearance.T, -np.inf)
    scored: dict[tuple[int, int], float] = {}
    for i in range(n):
        for j in np.argsort(-looks[i], kind="stable")[: settings.loop_candidates]:
            if looks[i, j] > settings.loop_appearance:
                scored[(min(i, int(j)), max(i, int(j)))] = float(looks[i, j])
    if settings.use_semantics:
        scored |= _semantic_candidates(unrelated, looks, summaries, settings)
    return sorted(scored, key=lambda pair: (-scored[pair], pair))


def _semantic_candidates(
    unrelated: NDArray[np.bool_], looks: NDArray, summaries: Sequence[LabelSummary], settings: GlobalBaConfig
) -> dict[tuple[int, int], float]:
    out: dict[tuple[int, int], float] = {}
    for i in np.flatnonzero(richness(summaries) > RICH).tolist():
        others = np.flatnonzero(unrelated[i]).tolist()
        scores = [similarity(summaries[i], summaries[j], float(looks[i, j]), WEIGHTS) for j in others]
        for k in np.argsort(-np.array(scores), kind="stable")[: settings.loop_candidates]:
            if scores[k] > SIMILAR:
                out[(min(i, others[k]), max(i, others[k]))] = float(scores[k])
    return out
