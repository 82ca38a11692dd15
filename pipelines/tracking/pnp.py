"""The pose of a frame from pixels and points."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..geometry import se3
from ..sfm.bundle import adjust_pose, reprojection_errors
from ..types import Array, Intrinsics

MAX_GAP = 3
"""Frames over which a velocity is still believed."""


POSE_ERROR = 3.0
"""Pixels within which a point agrees with a frame's pose."""
MIN_INLIERS = 20
"""A frame with fewer agreeing points is lost."""


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

    xy (Q, 2) pixels, points (Q, 3) in the world. A `start` (4, 4) is adjusted too and wins when it explains as many.
    """
    candidates = []
    if start is not None and len(xy) >= 6:
        candidates.append(start)
    if len(xy) >= 6:
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = max_error
        options.ransac.random_seed = seed
        options.ransac.min_num_trials, options.ransac.max_num_trials = 50, 2000
        found = pycolmap.estimate_absolute_pose(xy, points, colmap_camera(intrinsics), options)
        if found is not None:
            candidates.append(np.vstack([found["cam_from_world"].matrix(), [0, 0, 0, 1]]))
    best: FramePose | None = None
    for motion in candidates:
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
