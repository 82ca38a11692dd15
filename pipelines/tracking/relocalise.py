"""Finding a lost frame again among the keyframes: by how it looks, then by SIFT and PnP."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..sfm.matching import match_descriptors
from .pictures import Pictures
from .pnp import MIN_INLIERS, FramePose, solve_pose
from .state import NO_SIGHTINGS, Sightings, TrackState

Array = NDArray[np.float64]

CANDIDATES = 6
"""Similar keyframes in which a lost frame is looked for."""
RIVAL_SHARE = 0.5
"""Another place with this share of the best one's agreeing points is as good an answer."""
COMMON_POINTS = 8
"""Keyframes with so many points in common show one place."""


def relocalise(frame_id: int, state: TrackState, pictures: Pictures, seed: int) -> tuple[Sightings, FramePose | None]:
    """Sightings from the keyframes that look most like the frame, and the pose they agree on, if any.

    None, too, where two places explain the frame about as well and are apart: things that repeat, such as the doors of
    a corridor, do not show which of them is seen.
    """
    groups = _candidate_groups(frame_id, state, pictures, CANDIDATES)
    return recognise(frame_id, groups, state, pictures, seed)


def recognise(
    frame_id: int, groups: list[list[int]], state: TrackState, pictures: Pictures, seed: int
) -> tuple[Sightings, FramePose | None]:
    """Relocalise a frame among these groups of keyframes alone; returns what `relocalise` does."""
    answers: list[tuple[Sightings, FramePose, int]] = []
    most = NO_SIGHTINGS
    for group in groups:
        seen = NO_SIGHTINGS
        for keyframe in group:
            found = match_keyframe(frame_id, keyframe, state, pictures)
            seen = seen.joined(found.select(~np.isin(found.point, seen.point)))
        points = state.points[seen.point]
        solved = solve_pose(seen.xy, points, pictures.intrinsics, seed + frame_id)
        if solved is not None:
            answers.append((seen, solved, state.segment[group[0]]))
        elif len(seen) > len(most):
            most = seen
    if not answers:
        return most, None
    seen, solved, segment = max(answers, key=lambda a: int(a[1].inliers.sum()))
    depth = float(np.median((state.points[seen.point] @ solved.cam_from_world[2, :3]) + solved.cam_from_world[2, 3]))
    for _, other, its_segment in answers:
        as_good = other.inliers.sum() >= max(RIVAL_SHARE * solved.inliers.sum(), MIN_INLIERS)
        if as_good and its_segment == segment and _apart(other.cam_from_world, solved.cam_from_world, depth):
            return seen, None
    return seen, solved


def _apart(first: Array, second: Array, depth: float) -> bool:
    """Whether two poses of one frame differ by 10 degrees, or by a fifth of the distance of what it sees."""
    moved = first @ se3.inverse(second)
    return bool(se3.rotation_angle(moved) > np.radians(10) or np.linalg.norm(moved[:3, 3]) > 0.2 * max(depth, 0.0))


def match_keyframe(frame_id: int, keyframe: int, state: TrackState, pictures: Pictures) -> Sightings:
    """The keyframe's points found in the frame by SIFT; the frame's pixels are good to about one."""
    known = state.sightings[keyframe]
    if len(known) == 0:
        return NO_SIGHTINGS
    theirs, ours = pictures.features(keyframe), pictures.features(frame_id)
    pairs = match_descriptors(theirs.descriptors, ours.descriptors)
    points = known.points_at(theirs.xy[pairs[:, 0]])
    points, pairs = points[points >= 0], pairs[points >= 0]
    _, first = np.unique(points, return_index=True)
    first = np.sort(first)
    return Sightings.of(points[first], ours.xy[pairs[first, 1]], 1.0)


def _candidate_groups(frame_id: int, state: TrackState, pictures: Pictures, count: int) -> list[list[int]]:
    """Keyframes worth matching; neighbours that see common points are one group, so that their points add up."""
    if not state.keyframes:
        return []
    ours = pictures.descriptor(frame_id)
    scores = np.array([float(pictures.descriptor(k) @ ours) for k in state.keyframes])
    alike = [state.keyframes[i] for i in np.argsort(-scores, kind="stable")[:count]]
    return group_by_points({*alike, *state.nearest_keyframes(frame_id, 1)}, state)


def group_by_points(keyframes: Iterable[int], state: TrackState) -> list[list[int]]:
    """Keyframes in order, each in one group with the one before it if they see common points."""
    groups: list[list[int]] = []
    for keyframe in sorted(keyframes):
        if groups and _share_points(groups[-1][-1], keyframe, state):
            groups[-1].append(keyframe)
        else:
            groups.append([keyframe])
    return groups


def _share_points(first: int, second: int, state: TrackState) -> bool:
    shared = np.isin(state.sightings[first].point, state.sightings[second].point).sum()
    return bool(shared >= COMMON_POINTS)
