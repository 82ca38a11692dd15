"""Submaps: the keyframes of a long recording divided by what they see, and who keeps which Gaussian of their maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

from ..geometry.posed_depth import PosedDepth
from ..system.machine import submap_count

BORDER = 16
"""Keyframes of other submaps that a submap is made with beside its own."""
_SLACK, _UNEVEN = 0.3, 0.5
"""A cut may be this share of a submap away from where all become even; there it has to share this much less."""
_IN_ORDER = 1e-3
"""Overlap that keyframes beside each other in time have at least: what shows nothing known belongs to somewhere."""
_SHARES = 0.05
"""Submaps are neighbours where a keyframe of one has in its image this share of what one of the other shows."""
_SEEN_THROUGH = 0.05
"""Relative: a view says nothing about points farther behind its surface."""

_REST = 0.5
"""Shared keyframes that a submap's own exposures weigh as much as: what neighbours say of each other is a little
biased, which would add up over a long chain of submaps. So a difference fades over about eight of them, each of which
shares about 32 keyframes with the next. With 2 a kitchen in thirds has 27.20 dB, with this 27.22."""

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Submap:
    """Frame ids of keyframes, sorted: `own`, which no other submap has, and `border`, the others that share most with
    them; `neighbours`: numbers of the submaps that see some of the same."""

    own: Ids
    border: Ids
    neighbours: tuple[int, ...] = ()

    @staticmethod
    def whole(frame_ids: Ids) -> Submap:
        """One of all keyframes."""
        return Submap(frame_ids, frame_ids[:0])

    @property
    def views(self) -> Ids:
        """All that it is made from, sorted."""
        return np.union1d(self.own, self.border)


def divide(frame_ids: Ids, overlap: sparse.csr_matrix, size: int) -> list[Submap]:
    """Submaps of about `size` of the keyframes (N,), by their overlaps η (N, N); one of all where they are few, or size
    is 0.

    Halved again and again along the second eigenvector of the normalised covisibility (Shi and Malik, "Normalized Cuts
    and Image Segmentation", 2000), each time where least is shared near the middle: what sees the same place stays
    together, however often the walk comes back to it.
    """
    count = overlap.shape[0]
    chain = sparse.diags([np.full(max(count - 1, 0), _IN_ORDER)], [1], (count, count))
    shared = (overlap + overlap.T + chain + chain.T).tocsr()
    shared.setdiag(0)
    parts = _halve(shared, np.arange(count), submap_count(count, size))
    of = np.zeros(count, np.int64)
    for number, part in enumerate(parts):
        of[part] = number
    return [_with_border(frame_ids, shared, of, number) for number in range(len(parts))]


def _halve(shared: sparse.csr_matrix, rows: Ids, parts: int) -> list[Ids]:
    if parts == 1:
        return [rows]
    inside = shared[rows][:, rows]
    order = _along(inside)
    even, slack = len(rows) * (parts // 2) / parts, max(_SLACK * len(rows) / parts, 1.0)
    cuts = np.arange(max(int(even - slack), 1), min(int(even + slack) + 1, len(rows)))
    price = 1 + _UNEVEN * ((cuts - even) / slack) ** 2
    cut = int(cuts[(_crossing(inside, order)[cuts] * price).argmin()])
    sides = np.sort(rows[order[:cut]]), np.sort(rows[order[cut:]])
    halves = _halve(shared, sides[0], parts // 2) + _halve(shared, sides[1], parts - parts // 2)
    return sorted(halves, key=lambda part: int(part[0]))


def _along(shared: sparse.csr_matrix) -> Ids:
    """(n,) the rows in the order of the second eigenvector; in their own where none is found."""
    root = np.sqrt(np.asarray(shared.sum(1)).reshape(-1))
    scale = sparse.diags(1 / np.maximum(root, 1e-12))
    start = root * np.linspace(-1, 1, len(root))
    try:
        _, vectors = eigsh(scale @ shared @ scale, k=2, which="LA", v0=start, tol=1e-4)
    except (ArpackNoConvergence, TypeError):  # TypeError: of too few rows
        return np.arange(len(root))
    along = vectors[:, 0] / np.maximum(root, 1e-12)
    along = along if along @ np.linspace(-1, 1, len(along)) >= 0 else -along
    return np.argsort(along, kind="stable")


def _crossing(shared: sparse.csr_matrix, order: Ids) -> NDArray[np.float64]:
    """(n + 1,) what is shared by the first k rows of `order` and the others."""
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    pairs = shared.tocoo()
    first, last = place[pairs.row], place[pairs.col]
    forward = first < last
    ends = np.bincount(first[forward] + 1, pairs.data[forward], len(order) + 1)
    ends -= np.bincount(last[forward] + 1, pairs.data[forward], len(order) + 2)[: len(order) + 1]
    return np.cumsum(ends)


def _with_border(frame_ids: Ids, shared: sparse.csr_matrix, of: Ids, number: int) -> Submap:
    own = np.flatnonzero(of == number)
    rows = shared[own]
    with_each = np.asarray(rows.sum(0)).reshape(-1)
    with_each[own] = 0
    ranked = np.argsort(-with_each, kind="stable")[:BORDER]
    border = np.sort(ranked[with_each[ranked] > 2 * _IN_ORDER])
    neighbours = np.union1d(of[rows.indices[rows.data > _SHARES]], of[border])
    return Submap(frame_ids[own], frame_ids[border], tuple(int(n) for n in neighbours if n != number))


def nearest_seeing(points: NDArray[np.float64], views: Iterable[PosedDepth]) -> Ids:
    """(M,) for each of the points (M, 3) the number of the view that sees it, or through where it is, from nearest
    (measured along the view's axis); -1 where none does.

    It depends on the place alone: copies of a surface in two maps belong to the same view.
    """
    best, nearest = np.full(len(points), -1), np.full(len(points), np.inf)
    for number, view in enumerate(views):
        xy, z, inside = view.seen(points)
        rows = np.flatnonzero(inside & (z < nearest))
        place = xy[rows].astype(int)
        rows = rows[z[rows] < (1 + _SEEN_THROUGH) * view.depth[place[:, 1], place[:, 0]]]
        best[rows], nearest[rows] = number, z[rows]
    return best


@dataclass(frozen=True)
class SeenExposures:
    """Exposures of a submap's views, the bordering ones too: frame_ids (N,), log_gains and offsets (N, 3)."""

    frame_ids: NDArray[np.int64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]


def common_exposure(seen: Sequence[SeenExposures]) -> tuple[Array, Array]:
    """(S, 3) log gains and offsets that take the colours of each submap to those of all.

    Both submaps explain the photo of a keyframe that they share: gain_s x colours_s + offset_s = gain_t x colours_t +
    offset_t. The median over such keyframes for each two submaps, least squares over all of those.
    """
    rows = [{int(i): n for n, i in enumerate(s.frame_ids)} for s in seen]
    shared = {
        (s, t): [(rows[s][i], rows[t][i]) for i in sorted(rows[s].keys() & rows[t].keys())]
        for s, t in combinations(range(len(seen)), 2)
    }
    log_gains = _least_squares(len(seen), shared, lambda s, t, i, j: seen[s].log_gains[i] - seen[t].log_gains[j])

    def apart(s: int, t: int, i: int, j: int) -> Array:
        middle = (seen[s].log_gains[i] - log_gains[s] + seen[t].log_gains[j] - log_gains[t]) / 2
        return (seen[s].offsets[i] - seen[t].offsets[j]) / np.exp(middle)

    return log_gains, _least_squares(len(seen), shared, apart)


def _least_squares(
    count: int, shared: dict[tuple[int, int], list[tuple[int, int]]], apart: Callable[[int, int, int, int], Array]
) -> Array:
    """(count, 3) values whose differences are nearest to the medians of what shared keyframes say, zero on average."""
    normal, right = _REST * np.eye(count), np.zeros((count, 3))
    for (s, t), keyframes in shared.items():
        if keyframes:
            weight, step = len(keyframes), np.median([apart(s, t, i, j) for i, j in keyframes], axis=0)
            normal[[s, t], [s, t]] += weight
            normal[[s, t], [t, s]] -= weight
            right[s] += weight * step
            right[t] -= weight * step
    return np.asarray(np.linalg.solve(normal, right), np.float64)
