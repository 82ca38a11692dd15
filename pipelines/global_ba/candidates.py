"""Which keyframes might show the same place again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..config import GlobalBaConfig
from ..correspondence.retrieval import GlobalDescriptors, far_apart, loop_pairs
from ..geometry.sparse_model import SparseModel
from .semantics import LabelSummary, richness, similarity

GAP = 8
"""A loop joins keyframes at least this many apart."""
SHARED_POINTS = 15
"""Keyframes with this many points in common need no loop."""
RICH = 0.9
"""Keyframes of a richness above this propose loops by semantics, eq. (21)."""
PER_KEYFRAME, LEAST_ALIKE = 2, 0.02
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
    settings: GlobalBaConfig,
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

    alike = loop_pairs(looks, unrelated, PER_KEYFRAME, LEAST_ALIKE)
    by_labels = _semantic_candidates(unrelated, looks, summaries) if settings.use_semantics else set()
    return sorted(pair for pair in {*alike, *by_labels} if (ids[pair[0]], ids[pair[1]]) not in refused)


def _semantic_candidates(
    unrelated: Callable[[slice], NDArray[np.bool_]],
    looks: GlobalDescriptors,
    summaries: Sequence[LabelSummary],
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
