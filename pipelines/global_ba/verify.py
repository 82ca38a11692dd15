"""Does the geometry agree that two keyframes show the same place? PnP in both directions must say the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..correspondence.matching import match_descriptors
from ..geometry import se3
from ..geometry.camera import unproject
from ..tracking.pnp import FramePose, solve_pose
from ..tracking.state import Sightings
from ..types import Features, Intrinsics, LoopEdge

Array = NDArray[np.float64]

ERROR = 4.0
"""Pixels within which a feature agrees with a loop."""
INLIERS, SHARE = 25, 0.3
"""Least number and share of agreeing features, in both directions."""
ROTATION, TRANSLATION = 2.0, 0.05
"""By how much a loop's two directions may differ: degrees, and distance in units of the median depth."""


@dataclass(frozen=True)
class KeyframeView:
    """One keyframe as verification sees it: pose (4, 4), features, the point of each feature (-1 for none), and its
    position in the camera (Q, 3), NaN where neither a point nor a proxy depth gives one."""

    frame_id: int
    cam_from_world: Array
    features: Features
    point: NDArray[np.int64]
    in_cam: Array


@dataclass(frozen=True)
class Loop:
    """A verified pair: the edge, and the second keyframe's sightings of the first one's points, and vice versa."""

    edge: LoopEdge
    in_second: Sightings
    in_first: Sightings


def make_view(
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


def verify_loop(first: KeyframeView, second: KeyframeView, intrinsics: Intrinsics, seed: int) -> Loop | None:
    """The loop, if both directions find enough inliers, the same motion and a believable scale."""
    pairs = match_descriptors(first.features.descriptors, second.features.descriptors)
    forward = _locate(first, pairs[:, 0], second, pairs[:, 1], intrinsics, seed)
    backward = _locate(second, pairs[:, 1], first, pairs[:, 0], intrinsics, seed)
    if forward is None or backward is None:
        return None
    scale = _relative_scale(first, second, pairs, forward)
    depth = float(np.nanmedian(second.in_cam[:, 2]))
    # Backwards the translation comes in the second keyframe's scale.
    back = se3.inverse(backward.cam_from_world)
    disagreement = se3.inverse(back) @ se3.scaled(forward.cam_from_world, scale)
    if not (0.5 < scale < 2.0 and se3.rotation_angle(disagreement) < np.radians(ROTATION)):
        return None
    if np.linalg.norm(disagreement[:3, 3]) > TRANSLATION * depth:
        return None
    inliers = int(min(forward.inliers.sum(), backward.inliers.sum()))
    edge = LoopEdge(first.frame_id, second.frame_id, forward.cam_from_world, scale, inliers)
    agreed = pairs[forward.inliers & backward.inliers]
    return Loop(
        edge,
        _sightings(first, agreed[:, 0], second, agreed[:, 1]),
        _sightings(second, agreed[:, 1], first, agreed[:, 0]),
    )


def _locate(
    source: KeyframeView,
    source_index: NDArray[np.integer],
    target: KeyframeView,
    target_index: NDArray[np.integer],
    intrinsics: Intrinsics,
    seed: int,
) -> FramePose | None:
    """target_from_source by PnP, its inliers over all pairs; None when too few agree or they crowd in one spot."""
    known = np.isfinite(source.in_cam[source_index, 2])
    if known.sum() < INLIERS:
        return None
    xy = target.features.xy[target_index]
    solved = solve_pose(xy[known], source.in_cam[source_index[known]], intrinsics, seed, None, ERROR, 1.0)
    if solved is None or solved.inliers.sum() < max(INLIERS, SHARE * known.sum()):
        return None
    inliers = np.zeros(len(xy), bool)
    inliers[known] = solved.inliers
    spread = xy[inliers].std(0) / np.array([intrinsics.width, intrinsics.height])
    if spread.min() < 0.06:
        return None
    return FramePose(solved.cam_from_world, inliers)


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
