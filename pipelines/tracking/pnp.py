"""The pose of a frame from pixels and points; a lost frame found again among the keyframes: by how it looks, then by
SIFT and PnP."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..geometry import se3
from ..sfm.bundle import adjust_pose, reprojection_errors
from ..sfm.matching import match_descriptors
from ..types import Array, Intrinsics
from .state import NO_SIGHTINGS, Pictures, Sightings, TrackState

CANDIDATES = 6
"""Similar keyframes in which a lost frame is looked for."""
RIVAL_SHARE = 0.5
"""Another place with this share of the best one's agreeing points is as good an answer."""
COMMON_POINTS = 8
"""Keyframes with so many points in common show one place."""

MAX_GAP = 3
"""Frames over which a velocity is still believed."""


POSE_ERROR = 3.0
"""Pixels within which a point agrees with a frame's pose."""
MIN_INLIERS = 20
"""A frame with fewer agreeing points is lost."""
_NEARLY_ALL, _ENOUGH = 0.8, 50
"""Share and number of points that agree with where a frame was expected, from which nobody asks for another pose: of
254 frames of a kitchen RANSAC then found none better in 249, and one or two of 1270 points more in 5."""


@dataclass(frozen=True)
class FramePose:
    """cam_from_world (4, 4) and which correspondences (Q,) bool agree with it."""

    cam_from_world: Array
    inliers: NDArray[np.bool_]


def colmap_camera(intrinsics: Intrinsics) -> pycolmap.Camera:
    """Convert to pycolmap's pinhole camera, which also puts the first pixel's centre at (0.5, 0.5)."""
    params = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    return pycolmap.Camera(model="PINHOLE", width=intrinsics.width, height=intrinsics.height, params=params)


def solve_pose(
    xy: Array,
    points: Array,
    intrinsics: Intrinsics,
    seed: int,
    start: Array | None = None,
    max_error: float = POSE_ERROR,
    sd: float = 0.5,
) -> FramePose | None:
    """RANSAC on minimal sets (pycolmap), then motion-only robust adjustment; None where no pose explains six points.

    xy (Q, 2) pixels, points (Q, 3) in the world. A `start` (4, 4) is adjusted too and wins when it explains as many;
    where it explains nearly all there is no need of RANSAC.
    """
    if len(xy) < 6:
        return None
    best = None if start is None else _settle(start, xy, points, intrinsics, max_error, sd)
    if best is not None and best.inliers.sum() >= max(_ENOUGH, _NEARLY_ALL * len(xy)):
        return best
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error
    options.ransac.random_seed = seed
    options.ransac.min_num_trials, options.ransac.max_num_trials = 50, 2000
    found = pycolmap.estimate_absolute_pose(xy, points, colmap_camera(intrinsics), options)
    if found is not None:
        motion = np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]])
        adjusted = _settle(motion, xy, points, intrinsics, max_error, sd)
        if adjusted is not None and (best is None or adjusted.inliers.sum() > best.inliers.sum()):
            best = adjusted
    return best


def _settle(
    motion: Array, xy: Array, points: Array, intrinsics: Intrinsics, max_error: float, sd: float
) -> FramePose | None:
    """Adjust with the inliers, look again which they are, adjust once more."""
    for tolerance in (3 * max_error, max_error):
        inliers = _errors(motion, xy, points, intrinsics) < tolerance
        if inliers.sum() < 6:
            return None
        motion = adjust_pose(motion, points[inliers], xy[inliers], np.full(int(inliers.sum()), sd), intrinsics)
    inliers = _errors(motion, xy, points, intrinsics) < max_error
    return FramePose(motion, inliers) if inliers.sum() >= 6 else None


def _errors(motion: Array, xy: Array, points: Array, intrinsics: Intrinsics) -> Array:
    return reprojection_errors(points @ motion[:3, :3].T + motion[:3, 3], xy, intrinsics)


def interpolate_pose(first: Array, second: Array, share: float) -> Array:
    """(4, 4) pose at `share` of the screw motion from the first to the second; beyond [0, 1] it goes on."""
    return se3.exp(share * se3.log(second @ se3.inverse(first))) @ first


def predict_pose(frame_id: int, poses: Mapping[int, Array], times: Mapping[int, float]) -> Array | None:
    """Between two posed frames: on the screw motion between them. After the last: constant velocity (MSGS-SLAM eq. 15).

    Velocities are per second, so that frames need not be evenly spaced. None when nothing is posed.
    """
    before = sorted(i for i in poses if i < frame_id)[-2:]
    after = sorted(i for i in poses if i > frame_id)[:2]
    if before and after:
        pair = (before[-1], after[0])
    elif len(before) == 2 and frame_id - before[0] <= MAX_GAP:
        pair = (before[0], before[1])
    elif len(after) == 2 and after[1] - frame_id <= MAX_GAP:
        pair = (after[0], after[1])
    else:
        return poses[before[-1]] if before else poses[after[0]] if after else None
    start, end = times[pair[0]], times[pair[1]]
    share = (times[frame_id] - start) / (end - start) if end > start else 1.0
    # A time stamp that is off must not throw the prediction across the room.
    return interpolate_pose(poses[pair[0]], poses[pair[1]], float(np.clip(share, -1.0, 2.5)))


def relocalise(frame_id: int, state: TrackState, pictures: Pictures, seed: int) -> tuple[Sightings, FramePose | None]:
    """Sightings from the keyframes that look most like the frame, and the pose they agree on, if any.

    None, too, where two places explain the frame about as well and are apart: things that repeat, such as the doors of
    a corridor, do not show which of them is seen.
    """
    groups = _candidate_groups(frame_id, state, pictures, CANDIDATES)
    return localise_in_groups(frame_id, groups, state, pictures, seed)


def localise_in_groups(
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
    """Find the keyframe's points in the frame by SIFT; the frame's pixels are good to about one."""
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
    (scores,) = pictures.similarities(pictures.descriptor(frame_id)[None], state.keyframes)
    alike = [state.keyframes[i] for i in np.argsort(-scores, kind="stable")[:count]]
    return group_by_points({*alike, *state.nearest_keyframes(frame_id, 1)}, state)


def group_by_points(keyframes: Iterable[int], state: TrackState) -> list[list[int]]:
    """Keyframes in order, each in one group with the one before it if they see common points."""
    groups: list[list[int]] = []
    for keyframe in sorted(keyframes):
        points = state.sightings[keyframe].point
        if groups and np.isin(state.sightings[groups[-1][-1]].point, points).sum() >= COMMON_POINTS:
            groups[-1].append(keyframe)
        else:
            groups.append([keyframe])
    return groups
