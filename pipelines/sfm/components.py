"""Components of a path, and what holds each together: matches, shared points, and the covariance of an adjustment.

The share of agreeing pairs over a whole model hides one bad place among hundreds of good ones: a seam looks only at
what crosses between one keyframe and the next. Nor do reprojection errors tell whether poses are determined.
Where all that is seen is a narrow strip, the floor below a bare wall, cameras can turn about the strip and their
distances can grow, while every point stays within a fraction of a pixel.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, groupby, pairwise, product

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry import se3
from ..system.machine import windows_of
from ..types import Array, Intrinsics
from .adjust import FEATURE_SD
from .bundle import Bundle, Problem

MIN_POINTS = 12
_MIN_PAIRS = 3
_PAIR_AGREES = 0.5
MAX_SD = 0.005
"""Of two cameras that are determined relative to each other: standard deviation of the position in depths of what they
see, and of the direction in radians, for independent errors of `FEATURE_SD` (also of what was followed: those are alike
in neighbouring frames). Of 40 recordings those whose paths are right have at most 0.0042 between neighbours, two that
break before bare walls 0.0057 and 0.0093. True errors are 5 to 15 times as large: features of one strip are off
together."""
MAX_SCALE_SD, _SIDE = 0.02, 15
"""Relative, of the scale of the way on against that of the way before, by so many cameras of each: what pairs alone do
not hold together, fast steps along a corridor, does not part where this is known. There it is 0.003 to 0.017, where
made and real homes break before bare walls 0.19 to 1.1. A house where it is 0.010 is off by 0.09."""
LEAP, _AROUND = 3.0, 3
"""Times the speed that a path passes in one step of ten, and that of so many steps before and behind: of 24 recordings
with a right path the fastest step has at most 2.1, of six that are torn or folded 4 to 60."""
_LOOP_POINTS = 4 * MIN_POINTS
"""Of a loop between two runs: of false ones one of several things has 24, the right ones have 160 and more."""
_FLAT, _ON_PLANE = 0.05, 0.8
"""How far from a plane points lie on it, over their median distance from the middle of all, and the share of points
that are one plane. Of loops between rooms of made homes the false ones, a door or a picture that is like another, have
0.82 to 1, those of several things 0.3 to 0.75."""
_PLANES, _SAMPLED = 200, 2000
"""Planes that are tried, and about how many points they are tried on."""
_AT_ONCE, _SHARED = 200, 80
"""Cameras of one dense covariance, and those that it has in common with the next."""


@dataclass(frozen=True)
class PairCheck:
    """Number of matches of two keyframes (indices, first < second), and of those that agree with their poses."""

    first: int
    second: int
    matches: int
    agreeing: int

    @property
    def agrees(self) -> bool:
        """Return whether more than half of them do."""
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
        """Return whether the images on the two sides match, and contradict their poses."""
        return self.pairs >= _MIN_PAIRS and self.agreement < _PAIR_AGREES


def find_seams(
    placed: Sequence[int], checks: Iterable[PairCheck], tracks: Iterable[Sequence[int]], reach: int
) -> list[Seam]:
    """Find the seams of the placed keyframes (sorted indices); those more than `reach` places apart are no neighbours.

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


def find_leaps(centers: Array, times: Array) -> list[int]:
    """Indices of the places (N, 3) of a path that are too far from the one before for the time between, (N,) seconds:
    no camera goes so much faster than it hardly ever does, and than in all but two of the steps around."""
    if len(centers) < 3:
        return []
    speed = np.linalg.norm(np.diff(centers, axis=0), axis=1) / np.maximum(np.diff(times), 1e-3)
    found = np.flatnonzero(speed > LEAP * np.quantile(speed, 0.9)).tolist()
    around = {n: np.delete(speed[max(n - _AROUND, 0) : n + _AROUND + 1], min(n, _AROUND)) for n in found}
    return [n + 1 for n in found if speed[n] > LEAP * np.sort(around[n])[-3:][0]]


def worst_contradictions(seams: Iterable[Seam]) -> list[Seam]:
    """Return the worst seam of every run of contradicted ones: pairs that cross one mostly cross its neighbours."""
    runs = [list(run) for bad, run in groupby(seams, key=lambda s: s.is_contradicted) if bad]
    return [min(run, key=lambda s: s.agreement) for run in runs]


def remove_keyframes(model: pycolmap.Reconstruction, keyframes: Iterable[int]) -> None:
    """Remove keyframes and their observations from the model, in place, all that was seen from their places; image
    i + 1 is keyframe i."""
    for k in keyframes:
        model.deregister_frame(model.images[k + 1].frame_id)
    model.tear_down()  # the covariance of an adjustment wants a pose of every image there is


def find_components(
    placed: Sequence[int],
    seams: Iterable[Seam],
    tracks: Sequence[Sequence[int]],
    points: Array,
    reach: int,
    breaks: Container[int] = (),
) -> list[list[int]]:
    """Divide placed keyframes into components, largest first: runs between loose seams, joined where a loop, what is
    seen again more than `reach` places later, holds them together. No loop, the surest first, joins what is before and
    behind a keyframe of `breaks`: what looks alike in two rooms would; beyond a short run between two of those what is
    seen from both sides does. Nor do loops whose `points`, (T, 3) of the tracks, lie on one plane in rooms: doors and
    pictures are alike."""
    place = {k: n for n, k in enumerate(placed)}
    loose = {s.after for s in seams if s.is_weak_link}
    run = np.cumsum([k in loose for k in placed], dtype=np.int64).tolist()
    number = max(run, default=0)
    loops, across = defaultdict[tuple[int, int], list[int]](list), Counter[tuple[int, int]]()
    for n, track in enumerate(tracks if number else ()):
        near = [{run[at] for at in places} for places in _near(track, place, reach)]
        across.update({(a, b) for runs in near for a, b in combinations(sorted(runs), 2) if b > a + 1})
        for ab in {(min(ab), max(ab)) for first, second in combinations(near, 2) for ab in product(first, second)}:
            loops[ab].append(n)
    parted = [run[place[k]] for k in placed if k in loose and k in breaks]
    label = list(range(number + 1))
    held = {ab: across[ab] + len(loops[ab]) for ab in sorted({*across, *loops}) if ab[0] != ab[1]}

    def is_sure(a: int, b: int) -> bool:
        if across[a, b] >= 2 * MIN_POINTS:
            return True
        if held[a, b] < _LOOP_POINTS:
            return False
        around = [n for n, track in enumerate(tracks) if any(run[place[k]] in (a, b) for k in track)]
        return not is_flat_within(points[loops[a, b]], points[around])

    for a, b in sorted(held, key=lambda ab: -held[ab]):
        if not is_sure(a, b):
            continue
        together = [label[a] if x == label[b] else x for x in label]
        if all(together[n - 1] != together[n] for n in parted):
            label = together
    components: dict[int, list[int]] = {}
    for k in placed:
        components.setdefault(label[run[place[k]]], []).append(k)
    return sorted(components.values(), key=lambda p: (-len(p), p[0]))


def is_flat_within(points: Array, around: Array) -> bool:
    """Return whether points (N, 3) lie on one plane, though what is around (M, 3) does not, as from high above."""
    return are_on_one_plane(points) and not are_on_one_plane(around)


def are_on_one_plane(points: Array) -> bool:
    """Return whether most points (N, 3) lie on one plane, by the best of planes through three of them."""
    if len(points) < 4:
        return True
    off = points[:: -(-len(points) // _SAMPLED)]
    off = off - np.median(off, axis=0)
    corners = off[np.random.default_rng(0).integers(0, len(off), (_PLANES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.abs(normal @ off.T - (normal * corners[:, 0]).sum(1, keepdims=True))
    near = distance < _FLAT * float(np.median(np.linalg.norm(off, axis=1))) * length
    return bool(near.mean(1).max() >= _ON_PLANE)


def tracks_of(model: pycolmap.Reconstruction, total: int) -> list[list[int]]:
    """For every point the places it is seen from, sorted; image i + 1 is keyframe i, at place i % total."""
    return [sorted({(e.image_id - 1) % total for e in p.track.elements}) for p in model.points3D.values()]


def cut(model: pycolmap.Reconstruction, components: Sequence[Sequence[int]], total: int) -> None:
    """Remove, in place, observations by which a point is seen from more than one component; the larger one keeps it."""
    component = {k: n for n, members in enumerate(components) for k in members}
    for point_id in sorted(model.point3D_ids()):
        elements = model.points3D[point_id].track.elements
        owners = [component[(e.image_id - 1) % total] for e in elements]
        keeper = min(set(owners), key=lambda o: (-owners.count(o), o))
        stray = [(e.image_id, e.point2D_idx) for e, o in zip(elements, owners, strict=True) if o != keeper]
        for image_id, index in stray:
            if point_id in model.points3D:  # the last but one observation takes the point with it
                model.delete_observation(image_id, index)


# poses that the images determine --------------------------------------------------------------------------------


def undetermined_cameras(
    bundle: Bundle, intrinsics: Intrinsics, components: Iterable[Sequence[int]], least: int, counted: Container[int]
) -> tuple[list[int], list[list[int]]]:
    """List the cameras that the images do not determine against most of their component, in groups of fewer than
    `least` of those `counted`; and the larger groups beside the largest of a component. Where no group has most of it,
    nothing is better known than the rest: what is beside its largest group counts as one larger group."""
    loose: list[int] = []
    apart: list[list[int]] = []
    for component in components:
        members = np.array(sorted(component), np.int64)
        largest, *groups = pose_groups(_part(bundle, members), intrinsics)
        if 2 * len(largest) <= len(members):
            apart.append(members[sorted(k for group in groups for k in group)].tolist())
            continue
        for group in groups:
            inside = members[group].tolist()
            if sum(k in counted for k in inside) < least:
                loose += inside
            else:
                apart.append(inside)
    return sorted(loose), apart


def pose_groups(bundle: Bundle, intrinsics: Intrinsics) -> list[list[int]]:
    """Indices of the cameras of a bundle in groups, the largest first: within one the images determine the poses, pair
    by pair, or the scale of what comes before against what comes after (`MAX_SCALE_SD`).

    Of many cameras windows are looked at, whose covariances are larger than those of all. What two cameras that are in
    no window together see is taken to determine them.
    """
    count = len(bundle.cam_from_world)
    windows = windows_of(count, _AT_ONCE, _SHARED)
    ties = [_far_ties(bundle, windows)] if len(windows) > 1 else []
    for window in windows:
        known = PoseCovariance.of(_part(bundle, np.arange(window.start, window.stop)), intrinsics)
        pairs, sd = known.relative_sds()
        near = pairs[sd <= MAX_SD]
        ties += [near + window.start, known.scale_ties(_labels(near, len(window))) + window.start]
    label = _labels(np.concatenate(ties), count)
    groups = [np.flatnonzero(label == n).tolist() for n in range(int(label.max(initial=-1)) + 1)]
    return sorted(groups, key=lambda g: (-len(g), g))


def _labels(ties: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """(N,) numbers of the groups that ties (E, 2) make of N cameras."""
    graph = coo_matrix((np.ones(len(ties)), (ties[:, 0], ties[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


@dataclass(frozen=True)
class PoseCovariance:
    """covariance (N, 6, N, 6) of the twists of cameras cam_from_world (N, 4, 4), up to motions and the scale of the
    whole; depth (N,) of what each sees, all in the median depth; pairs (E, 2) of them that share a point."""

    cam_from_world: Array
    depth: Array
    pairs: NDArray[np.int64]
    covariance: Array

    @staticmethod
    def of(bundle: Bundle, intrinsics: Intrinsics) -> PoseCovariance:
        """For independent errors of `FEATURE_SD`."""
        depth = _median_depths(bundle)
        unit = float(np.median(depth))
        scaled = replace(
            bundle, cam_from_world=se3.scaled(bundle.cam_from_world, 1 / unit), points=bundle.points / unit,
            obs_depth=bundle.obs_depth / unit, obs_sd=np.full(len(bundle.obs_cam), FEATURE_SD),
        )  # fmt: skip
        problem = Problem(scaled, intrinsics)
        count, at = len(depth), (np.ascontiguousarray(scaled.cam_from_world), scaled.points)
        blocks, _, _ = problem.reduced(at, problem.linearise(*at), 1e-9)
        upper = np.zeros((count, 6, count, 6))
        upper[problem.pairs[:, 0], :, problem.pairs[:, 1], :] = blocks
        dense = np.triu(upper.reshape(6 * count, 6 * count))
        dense += np.triu(dense, 1).T
        # What moves and scales the whole is free: held as firmly as all the rest is, so that there is an inverse.
        free = _free_motions(scaled.cam_from_world)
        firm = np.trace(dense) / len(dense) * free @ free.T
        covariance = np.linalg.inv(dense + firm + 1e-9 * np.eye(6 * count)).reshape(count, 6, count, 6)
        pairs = problem.pairs[problem.pairs[:, 0] != problem.pairs[:, 1]]
        return PoseCovariance(scaled.cam_from_world, depth / unit, pairs, covariance)

    def relative_sds(self) -> tuple[NDArray[np.int64], Array]:
        """The pairs, and how exactly one's pose relative to the other's is determined (E,), as in `MAX_SD`: the larger
        of position and direction."""
        a, b = self.pairs.T
        carry = _adjoint(self.cam_from_world[b] @ se3.inverse(self.cam_from_world[a]))
        back = np.swapaxes(carry, 1, 2)
        mixed = carry @ self.covariance[a, :, b, :]
        own = carry @ self.covariance[a, :, a, :] @ back + self.covariance[b, :, b, :]
        variance = np.maximum(np.einsum("eii->ei", own - mixed - np.swapaxes(mixed, 1, 2)), 0.0)
        place, turn = variance[:, :3].sum(1), variance[:, 3:].sum(1)
        return self.pairs, np.sqrt(np.maximum(place / np.minimum(self.depth[a], self.depth[b]) ** 2, turn))

    def scale_ties(self, label: NDArray[np.int64]) -> NDArray[np.int64]:
        """(E, 2) neighbours of two groups, of which label (N,) has the numbers, where the way on, from the last camera
        of one, is of a size that is known well enough against the way before."""
        label, ties = label.copy(), []
        for k in (np.flatnonzero(np.diff(label)) + 1).tolist():
            before = np.flatnonzero(label[:k] == label[k - 1])[-_SIDE:]
            after = np.append(k - 1, k + np.flatnonzero(label[k:] == label[k])[:_SIDE])
            a, b = label[self.pairs].T
            share = ((a == label[k - 1]) & (b == label[k])) | ((a == label[k]) & (b == label[k - 1]))
            if len(before) > 1 and share.any() and self.scale_sd(before, after) <= MAX_SCALE_SD:
                label[label == label[k]] = label[k - 1]
                ties.append((k - 1, k))
        return np.array(ties, np.int64).reshape(-1, 2)

    def scale_sd(self, before: NDArray[np.int64], after: NDArray[np.int64]) -> float:
        """Relative standard deviation of the size of one way, by its cameras, over that of another."""
        step, centers = np.zeros((*self.cam_from_world.shape[:1], 6)), se3.inverse(self.cam_from_world)[:, :3, 3]
        for way, sign in ((before, 1.0), (after, -1.0)):
            aside = centers[way] - centers[way].mean(0)
            aside *= sign / max(float((aside**2).sum()), 1e-12)
            step[way, :3] += np.einsum("nij,nj->ni", self.cam_from_world[way, :3, :3], aside)
        variance = step.ravel() @ self.covariance.reshape(step.size, -1) @ step.ravel()
        return float(np.sqrt(np.maximum(variance, 0.0)))


def _median_depths(bundle: Bundle) -> Array:
    """(N,) of what each camera sees; the median of all for one that sees nothing."""
    depth, order = bundle.points_in_cam()[:, 2], np.argsort(bundle.obs_cam, kind="stable")
    order = order[depth[order] > 0]
    edges = np.searchsorted(bundle.obs_cam[order], np.arange(len(bundle.cam_from_world) + 1)).tolist()
    own = [depth[order[i:j]] for i, j in pairwise(edges)]
    middle = float(np.median(depth[order])) if len(order) else 1.0
    return np.array([np.median(d) if len(d) else middle for d in own])


def _free_motions(cam_from_world: Array) -> Array:
    """(6 N, 7) orthonormal steps of all cameras that no image tells: those of the whole, and its scale."""
    count = len(cam_from_world)
    steps = np.zeros((count, 6, 7))
    steps[:, :, :6] = _adjoint(cam_from_world)
    centre = se3.inverse(cam_from_world)[:, :3, 3].mean(0)
    steps[:, :3, 6] = cam_from_world[:, :3, :3] @ centre + cam_from_world[:, :3, 3]
    return np.linalg.qr(steps.reshape(6 * count, 7))[0]


def _adjoint(motions: Array) -> Array:
    """(N, 6, 6): what a twist (translation first) is after each of the motions (N, 4, 4)."""
    out, turn, shift = np.zeros((len(motions), 6, 6)), motions[:, :3, :3], motions[:, :3, 3]
    out[:, :3, :3] = out[:, 3:, 3:] = turn
    out[:, :3, 3:] = np.cross(shift[:, :, None], turn, axis=1)
    return out


def _part(bundle: Bundle, cameras: NDArray[np.int64]) -> Bundle:
    """The bundle of these cameras, with the points that they see."""
    number = np.full(len(bundle.cam_from_world) + 1, -1)  # the last one stands for no source
    number[cameras] = np.arange(len(cameras))
    part = bundle.select(number[bundle.obs_cam] >= 0)
    used, point = np.unique(part.obs_point, return_inverse=True)
    return replace(
        part, cam_from_world=bundle.cam_from_world[cameras], points=bundle.points[used],
        obs_cam=number[part.obs_cam], obs_point=point.astype(np.int64), obs_source=number[part.obs_source],
    )  # fmt: skip


def _far_ties(bundle: Bundle, windows: list[range]) -> NDArray[np.int64]:
    """(E, 2) cameras that share enough points for a pose and are in no window together."""
    seen = csr_matrix((np.ones(len(bundle.obs_cam)), (bundle.obs_cam, bundle.obs_point)))
    shared = coo_matrix(seen @ seen.T)
    first, second = shared.row, shared.col
    far = (shared.data >= MIN_POINTS) & (first < second)
    for window in windows:
        far &= (first < window.start) | (second >= window.stop)
    return np.column_stack([first[far], second[far]]).astype(np.int64)
