"""Motion model: prediction of a camera's pose before its image is used."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3

Array = NDArray[np.float64]

MAX_GAP = 3
"""Frames over which a velocity is still believed."""


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
