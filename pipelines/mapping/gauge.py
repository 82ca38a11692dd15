"""One exposure for all submaps: those of its views are relative, and each submap was made with its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_REST = 0.5
"""Shared keyframes that a submap's own exposures weigh as much as: what neighbours say of each other is a little
biased, which would add up over a long chain of submaps. So a difference fades over about eight of them, each of which
shares about 32 keyframes with the next. With 2 a kitchen in thirds has 27.20 dB, with this 27.22."""


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
