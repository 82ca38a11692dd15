"""Seams of a path: neighbouring keyframes whose images do not hold the two sides together.

The share of agreeing pairs over a whole model hides one bad place among hundreds of good ones. A seam looks only at
what crosses between one keyframe and the next.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby, product

import numpy as np
import pycolmap
from numpy.typing import NDArray

MIN_POINTS = 12
_MIN_PAIRS = 3
_PAIR_AGREES = 0.5


@dataclass(frozen=True)
class PairCheck:
    """Number of matches of two keyframes (indices, first < second), and of those that agree with their poses."""

    first: int
    second: int
    matches: int
    agreeing: int

    @property
    def agrees(self) -> bool:
        """Whether more than half of them do."""
        return self.agreeing > _PAIR_AGREES * self.matches


@dataclass(frozen=True)
class Seam:
    """Between a placed keyframe and the next placed one (indices).

    points: seen on both sides by keyframes near each other; if fewer, those that hold the size over the end that shares
    more with its other neighbour: a point seen before a keyframe, behind it and by three or more in all. Two structures
    that share a keyframe alone, and points of two views each, may be of any size beside each other, and no reprojection
    error tells. pairs: of keyframes near each other, one on each side, that match; agreement: the share of their
    matches in pairs that agree with the poses. Things that repeat match falsely, but with fewer matches than what is
    truly seen twice: so that pairs are weighed.
    """

    before: int
    after: int
    points: int
    pairs: int
    agreement: float

    @property
    def is_weak_link(self) -> bool:
        """Too few points for a pose and a scale of one side from the other."""
        return self.points < MIN_POINTS

    @property
    def is_contradicted(self) -> bool:
        """The images on the two sides match, and contradict their poses."""
        return self.pairs >= _MIN_PAIRS and self.agreement < _PAIR_AGREES


def find_seams(
    placed: Sequence[int], checks: Iterable[PairCheck], tracks: Iterable[Sequence[int]], reach: int
) -> list[Seam]:
    """All seams of the placed keyframes (sorted indices); keyframes more than `reach` places apart are no neighbours.

    `tracks` are the keyframes (sorted indices) that see a point, for every point.
    """
    place = {k: n for n, k in enumerate(placed)}
    points, ties, pairs, matches, agreeing = (np.zeros(len(placed) + 1, np.int64) for _ in range(5))

    def cross(counts: NDArray[np.int64], first: int, last: int, weight: int = 1) -> None:
        counts[first] += weight
        counts[last] -= weight

    for track in tracks:
        for near in _near(track, place, reach):
            cross(points, near[0], near[-1])
            if len(near) > 2:
                cross(ties, near[0] + 1, near[-1])
    for check in checks:
        a, b = place[check.first], place[check.second]
        if b - a <= reach:
            cross(pairs, a, b)
            cross(matches, a, b, check.matches)
            if check.agrees:
                cross(agreeing, a, b, check.matches)
    points, ties, pairs, matches, agreeing = (
        np.cumsum(c)[: len(placed) - 1] for c in (points, ties, pairs, matches, agreeing)
    )
    for k in range(1, len(placed) - 1):
        weaker = k - (points[k - 1] <= points[k])  # the seam before k, or the one behind it
        points[weaker] = min(points[weaker], ties[k])
    agreement = agreeing / np.maximum(matches, 1)
    crossing = points.tolist(), pairs.tolist(), agreement.tolist()
    return [Seam(*row) for row in zip(placed[:-1], placed[1:], *crossing, strict=True)]


def _near(track: Sequence[int], place: dict[int, int], reach: int) -> list[list[int]]:
    """A track's places in runs, within which no step is longer than `reach`."""
    runs: list[list[int]] = []
    for at in (place[k] for k in track):
        if runs and at - runs[-1][-1] <= reach:
            runs[-1].append(at)
        else:
            runs.append([at])
    return runs


def worst_contradictions(seams: Iterable[Seam]) -> list[Seam]:
    """Return the worst seam of every run of contradicted ones: pairs that cross one mostly cross its neighbours."""
    runs = [list(run) for bad, run in groupby(seams, key=lambda s: s.is_contradicted) if bad]
    return [min(run, key=lambda s: s.agreement) for run in runs]


def find_misplaced(checks: Iterable[PairCheck], reach: int) -> list[int]:
    """Keyframes that most of their neighbours contradict, taken out one after the other until there are none left.

    Such are one or a few views that a mapper put before another wall of the same pattern. Of a long run that lies
    elsewhere, a fold, the keyframes have each other to agree with, and stay.
    """
    near = [c for c in checks if c.second - c.first <= reach]
    out: list[int] = []
    while True:
        pairs, matches, agreeing = Counter[int](), Counter[int](), Counter[int]()
        for check in near:
            for k in (check.first, check.second):
                pairs[k] += 1
                matches[k] += check.matches
                agreeing[k] += check.matches * check.agrees
        wrong = [k for k in pairs if pairs[k] >= _MIN_PAIRS and agreeing[k] < _PAIR_AGREES * matches[k]]
        if not wrong:
            return out
        out.append(min(wrong, key=lambda k: (agreeing[k] / matches[k], k)))
        near = [c for c in near if out[-1] not in (c.first, c.second)]


def remove_keyframes(model: pycolmap.Reconstruction, keyframes: Iterable[int]) -> None:
    """Remove keyframes and their observations from the model, in place, all that was seen from their places; image
    i + 1 is keyframe i."""
    for k in keyframes:
        model.deregister_frame(model.images[k + 1].frame_id)
    model.tear_down()  # the covariance of an adjustment wants a pose of every image there is


def find_parts(
    placed: Sequence[int], seams: Iterable[Seam], tracks: Iterable[Sequence[int]], reach: int
) -> list[list[int]]:
    """Placed keyframes in parts, largest first: runs between loose seams, joined where a loop, what is seen again more
    than `reach` places later, holds them together."""
    place = {k: n for n, k in enumerate(placed)}
    loose = {s.after for s in seams if s.is_weak_link}
    run = np.cumsum([k in loose for k in placed], dtype=np.int64).tolist()
    number = max(run, default=0)
    shared = np.zeros((number + 1, number + 1), np.int64)
    for track in tracks:
        for first, second in combinations([{run[n] for n in near} for near in _near(track, place, reach)], 2):
            for a, b in product(first, second):
                shared[min(a, b), max(a, b)] += 1
    label = list(range(number + 1))
    for a, b in np.argwhere(np.triu(shared, 1) >= 2 * MIN_POINTS).tolist():
        label = [label[a] if x == label[b] else x for x in label]
    parts: dict[int, list[int]] = {}
    for k in placed:
        parts.setdefault(label[run[place[k]]], []).append(k)
    return sorted(parts.values(), key=lambda p: (-len(p), p[0]))


def parts_of(model: pycolmap.Reconstruction, total: int, reach: int) -> list[list[int]]:
    """Divide the placed keyframes of a model as `find_parts` does; image i + 1 is keyframe i, at place i % total."""
    placed, tracks = sorted({(i - 1) % total for i in model.reg_image_ids()}), tracks_of(model, total)
    return find_parts(placed, find_seams(placed, (), tracks, reach), tracks, reach)


def tracks_of(model: pycolmap.Reconstruction, total: int) -> list[list[int]]:
    """For every point the places it is seen from, sorted; image i + 1 is keyframe i, at place i % total."""
    return [sorted({(e.image_id - 1) % total for e in p.track.elements}) for p in model.points3D.values()]


def cut(model: pycolmap.Reconstruction, parts: Sequence[Sequence[int]], total: int) -> None:
    """Take the observations away by which a point is seen from more than one part of the places, in place; the larger
    part keeps it."""
    part = {k: n for n, members in enumerate(parts) for k in members}
    for point_id in sorted(model.point3D_ids()):
        elements = model.points3D[point_id].track.elements
        owners = [part[(e.image_id - 1) % total] for e in elements]
        keeper = min(set(owners), key=lambda o: (-owners.count(o), o))
        stray = [(e.image_id, e.point2D_idx) for e, o in zip(elements, owners, strict=True) if o != keeper]
        for image_id, index in stray:
            if point_id in model.points3D:  # the last but one observation takes the point with it
                model.delete_observation(image_id, index)
