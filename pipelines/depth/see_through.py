"""Depth that stands in front of what other views see there is wrong, and would become a floater."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.depth.posed import PosedDepth, neighbours

STRIDE = 2
AGREES = 0.03
"""Relative difference up to which another view confirms a depth."""
SEES_THROUGH = 0.08
"""Relative difference from which the other view's surface is plainly behind it."""
_TRUSTED = 0.5


def contradicted(views: Sequence[PosedDepth]) -> Iterator[NDArray[np.bool_]]:
    """(H, W) of each view in turn: pixels whose depth more of the others (two at least) see through than confirm."""
    seeing: dict[int, list[int]] = {}
    for i, j in neighbours(views):
        seeing.setdefault(i, []).append(j)
    for i, view in enumerate(views):
        votes = np.zeros(view.depth[::STRIDE, ::STRIDE].shape, np.int16)
        through = np.zeros_like(votes)
        for j in seeing.get(i, []):
            confirmed, seen_through = _votes(view, views[j])
            votes += confirmed
            through += seen_through
        bad = (through >= 2) & (through > votes)
        height, width = view.depth.shape
        yield np.repeat(np.repeat(bad, STRIDE, axis=0), STRIDE, axis=1)[:height, :width]


def _votes(view: PosedDepth, other: PosedDepth) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) bool each: the other view confirms the depth of the strided pixels; it sees through it."""
    strided = view.depth[::STRIDE, ::STRIDE]
    rows, columns = np.nonzero(strided)
    xy = np.stack([columns, rows], 1).astype(np.float64) * STRIDE + 0.5
    there, z, inside = other.seen(view.in_world(xy, strided[rows, columns].astype(np.float64)))
    place = np.where(inside[:, None], there, 0).astype(int)
    seen = other.depth[place[:, 1], place[:, 0]]
    usable = inside & (seen > 0) & (other.trust[place[:, 1], place[:, 0]] > _TRUSTED)
    confirmed, through = np.zeros(strided.shape, bool), np.zeros(strided.shape, bool)
    confirmed[rows, columns] = usable & (np.abs(z - seen) < AGREES * seen)
    through[rows, columns] = usable & (z < (1 - SEES_THROUGH) * seen)
    return confirmed, through
