"""Finding loops: candidates by appearance, geometric verification, and two tests that a false loop of repeated texture
fails."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..geometry import se3
from ..geometry.camera import unproject
from ..geometry.sparse_model import SparseModel
from ..sfm.features import GlobalDescriptors, far_apart, loop_pairs
from ..sfm.matching import match_descriptors
from ..tracking.pnp import FramePose, solve_pose
from ..tracking.state import Sightings
from ..types import Array, Features, Intrinsics, LoopEdge

GAP = 8
"""A loop joins keyframes at least this many apart."""
SHARED_POINTS = 15
"""Keyframes with this many points in common need no loop."""
PER_KEYFRAME, MIN_ALIKE = 2, 0.02
"""Loops proposed by each keyframe's appearance, and the least appearance similarity of one."""
ERROR = 4.0
"""Pixels within which a feature agrees with a loop."""
INLIERS, SHARE = 25, 0.3
"""Least number and share of agreeing features, in both directions."""
ROTATION, TRANSLATION = 2.0, 0.05
"""By how much a loop's two directions may differ: degrees, and distance in units of the median depth."""

AGREEMENT = 3.0
"""Times the tolerance of one measurement, within which a neighbouring loop agrees: there are two measurements, and the
steps between the neighbours."""
SURE_INLIERS = 80
"""With so many a loop needs no support by its neighbours."""
DRIFT, ANGLE_DRIFT, SCALE_DRIFT = 0.05, 10.0, 1.5
"""A loop is false that claims more drift than this share of the path, more degrees, or a larger factor of scale."""


def shared_points(model: SparseModel) -> csr_matrix:
    """(N, N): how many points two keyframes both see."""
    seen = model.seen.astype(np.int32)
    return (seen @ seen.T).tocsr()


def loop_candidates(
    model: SparseModel, descriptors: GlobalDescriptors, refused: Collection[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of keyframe indices, sorted: the most alike of each keyframe that are far apart in
    the sequence and have hardly a point in common; none of the pairs of frame ids that structure from motion has
    refused."""
    ids = model.frame_ids.tolist()
    shared, apart = shared_points(model), far_apart(len(ids), GAP)

    def unrelated(part: slice) -> NDArray[np.bool_]:
        return apart(part) & (shared[part].toarray() < SHARED_POINTS)

    alike = loop_pairs(descriptors, unrelated, PER_KEYFRAME, MIN_ALIKE)
    return [(i, j) for i, j in alike if (ids[i], ids[j]) not in refused]


@dataclass(frozen=True)
class KeyframeView:
    """One keyframe as verification sees it: pose (4, 4), features, the point of each feature (-1 for none), and its
    position in the camera (Q, 3), NaN where neither a point nor a proxy depth gives one."""

    frame_id: int
    cam_from_world: Array
    features: Features
    point: NDArray[np.int64]
    in_cam: Array

    @property
    def depth(self) -> float:
        """Median depth of the features."""
        return float(np.nanmedian(self.in_cam[:, 2]))


def make_keyframe_view(
    frame_id: int,
    cam_from_world: Array,
    features: Features,
    sightings: Sightings,
    points: Array,
    depth: Array,
    intrinsics: Intrinsics,
) -> KeyframeView:
    """A keyframe with its points (P, 3), and depth (Q,) at its features, 0 where unknown."""
    point = sightings.points_at(features.xy)
    near = point >= 0
    in_cam = np.where(depth[:, None] > 0, unproject(features.xy, depth, intrinsics), np.nan)
    in_cam[near] = points[point[near]] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    return KeyframeView(frame_id, cam_from_world, features, point, in_cam)


@dataclass(frozen=True)
class Loop:
    """A verified pair: the edge, and the second keyframe's sightings of the first one's points, and vice versa."""

    edge: LoopEdge
    in_second: Sightings
    in_first: Sightings


@dataclass(frozen=True)
class FoundLoops:
    """Accepted loops, and how many pairs were rejected at which test."""

    loops: list[Loop]
    tried: int
    implausible: int
    unsupported: int


@dataclass(frozen=True)
class LoopSearch:
    """Verification of pairs of keyframes, by the indices of their `views`, which may be made on demand."""

    views: Sequence[KeyframeView]
    cam_from_world: Array
    intrinsics: Intrinsics
    seed: int

    def find(self, pairs: Iterable[tuple[int, int]]) -> FoundLoops:
        """Verify candidate pairs.

        A verified pair is still refused when the drift it claims is more than the path between its keyframes can have
        collected, or when no neighbouring pair says the same and it has not many inliers itself: two equal posters on a
        wall match perfectly, but contradict the path between them.
        """
        centres = se3.inverse(self.cam_from_world)[:, :3, 3]
        path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
        verified: dict[tuple[int, int], Loop] = {}
        tried = implausible = 0
        for pair in pairs:
            tried += 1
            loop = self.verify(*pair)
            if loop is None:
                continue
            if self._is_plausible(loop, pair, float(path[pair[1]] - path[pair[0]])):
                verified[pair] = loop
            else:
                implausible += 1
        supported = [
            loop
            for pair, loop in verified.items()
            if loop.edge.inliers >= SURE_INLIERS or self._has_support(pair, loop, verified)
        ]
        return FoundLoops(supported, tried, implausible, len(verified) - len(supported))

    def verify(self, first: int, second: int) -> Loop | None:
        """The loop, if both directions find enough inliers, the same motion and a believable scale."""
        one, two = self.views[first], self.views[second]
        pairs = match_descriptors(one.features.descriptors, two.features.descriptors)
        forward = self._locate(one, pairs[:, 0], two, pairs[:, 1])
        backward = self._locate(two, pairs[:, 1], one, pairs[:, 0])
        if forward is None or backward is None:
            return None
        scale = _relative_scale(one, two, pairs, forward)
        # Backwards the translation comes in the second keyframe's scale.
        back = se3.inverse(backward.cam_from_world)
        disagreement = se3.inverse(back) @ se3.scaled(forward.cam_from_world, scale)
        if not (0.5 < scale < 2.0 and _is_near(disagreement, two.depth)):
            return None
        inliers = int(min(forward.inliers.sum(), backward.inliers.sum()))
        edge = LoopEdge(one.frame_id, two.frame_id, forward.cam_from_world, scale, inliers)
        agreed = pairs[forward.inliers & backward.inliers]
        return Loop(
            edge, _sightings(one, agreed[:, 0], two, agreed[:, 1]), _sightings(two, agreed[:, 1], one, agreed[:, 0])
        )

    def _locate(
        self,
        source: KeyframeView,
        source_index: NDArray[np.integer],
        target: KeyframeView,
        target_index: NDArray[np.integer],
    ) -> FramePose | None:
        """target_from_source by PnP, its inliers over all pairs; None when too few agree or they crowd in one spot."""
        known = np.isfinite(source.in_cam[source_index, 2])
        if known.sum() < INLIERS:
            return None
        xy, camera = target.features.xy[target_index], self.intrinsics
        solved = solve_pose(xy[known], source.in_cam[source_index[known]], camera, self.seed, None, ERROR, 1.0)
        if solved is None or solved.inliers.sum() < max(INLIERS, SHARE * known.sum()):
            return None
        inliers = np.zeros(len(xy), bool)
        inliers[known] = solved.inliers
        spread = xy[inliers].std(0) / np.array([camera.width, camera.height])
        return FramePose(solved.cam_from_world, inliers) if spread.min() >= 0.06 else None

    def _is_plausible(self, loop: Loop, pair: tuple[int, int], path: float) -> bool:
        """Whether a path of that length can have drifted as far as the loop claims."""
        now, then = self._relative(pair[1], pair[0]), loop.edge.frame2_from_frame1
        distance = float(np.linalg.norm(se3.inverse(now)[:3, 3] - se3.inverse(then)[:3, 3]))
        return bool(
            distance <= DRIFT * path + TRANSLATION * self.views[pair[0]].depth
            and se3.rotation_angle(then @ se3.inverse(now)) <= np.radians(ANGLE_DRIFT)
            and abs(np.log(loop.edge.scale)) <= np.log(SCALE_DRIFT)
        )

    def _has_support(self, pair: tuple[int, int], loop: Loop, verified: dict[tuple[int, int], Loop]) -> bool:
        """Whether a neighbouring pair is verified too and puts the keyframes in the same places."""
        first, second = pair
        near = [(first + a, second + b) for a in (-2, -1, 0, 1, 2) for b in (-2, -1, 0, 1, 2) if (a, b) != (0, 0)]
        known = [p for p in near if p in verified]
        fresh = [(first + 1, second), (first, second - 1), (first - 1, second), (first, second + 1)]
        for other in known + [p for p in fresh if p not in verified and 0 <= p[0] < p[1] < len(self.views)]:
            candidate = verified.get(other) or self.verify(*other)
            if candidate is not None and self._agree(loop, pair, candidate, other):
                return True
        return False

    def _agree(self, loop: Loop, pair: tuple[int, int], other: Loop, other_pair: tuple[int, int]) -> bool:
        """Carry the other loop over to this pair along the present poses of the neighbours: the same motion?"""
        before, after = self._relative(other_pair[0], pair[0]), self._relative(pair[1], other_pair[1])
        carried = after @ other.edge.frame2_from_frame1 @ before
        return _is_near(carried @ se3.inverse(loop.edge.frame2_from_frame1), self.views[pair[1]].depth, AGREEMENT)

    def _relative(self, target: int, source: int) -> Array:
        return self.views[target].cam_from_world @ se3.inverse(self.views[source].cam_from_world)


def _is_near(apart: Array, depth: float, times: float = 1.0) -> bool:
    """Whether two motions that are so far apart agree, to so many times the tolerance of one measurement."""
    return bool(
        se3.rotation_angle(apart) < times * np.radians(ROTATION)
        and np.linalg.norm(apart[:3, 3]) < times * TRANSLATION * depth
    )


def _relative_scale(first: KeyframeView, second: KeyframeView, pairs: NDArray[np.integer], forward: FramePose) -> float:
    """Depth the second keyframe itself gives its features, over depth by the first one's points; 1 without drift."""
    used = pairs[forward.inliers]
    motion = forward.cam_from_world
    moved = first.in_cam[used[:, 0]] @ motion[:3, :3].T + motion[:3, 3]
    own = second.in_cam[used[:, 1], 2]
    both = np.isfinite(own) & (own > 0) & (moved[:, 2] > 0)
    return float(np.exp(np.median(np.log(own[both] / moved[both, 2])))) if both.sum() >= 10 else 1.0


def _sightings(
    source: KeyframeView, source_index: NDArray[np.integer], target: KeyframeView, target_index: NDArray[np.integer]
) -> Sightings:
    """Where the target sees points of the source."""
    point = source.point[source_index]
    known = point >= 0
    xy = target.features.xy[target_index[known]]
    return Sightings.of(point[known], xy, 1.0)
