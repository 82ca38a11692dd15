"""The trajectory after the keyframes have moved: every frame goes along with its neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..types import Trajectory


def move_trajectory(
    trajectory: Trajectory, keyframe_ids: NDArray[np.int64], cam_from_world: NDArray[np.float64]
) -> Trajectory:
    """The trajectory with keyframes at their new poses (N, 4, 4), the frames between at interpolated corrections.

    A keyframe's correction is new_cam_from_world @ old_world_from_cam; between two keyframes its twist is linear in
    time, before the first and after the last it is theirs.
    """
    row = {int(i): n for n, i in enumerate(trajectory.frame_ids)}
    rows = np.array([row[int(i)] for i in keyframe_ids])
    twists = se3.log(cam_from_world @ trajectory.world_from_cam[rows])
    times = trajectory.timestamps[rows]
    order = np.argsort(times, kind="stable")
    between = np.stack([np.interp(trajectory.timestamps, times[order], twists[order, k]) for k in range(6)], axis=1)
    moved = se3.exp(between) @ trajectory.cam_from_world
    moved[rows] = cam_from_world
    moved[~trajectory.is_posed] = np.eye(4)
    return replace(trajectory, cam_from_world=moved)


def rows_of(trajectory: Trajectory, frame_ids: NDArray[np.int64]) -> Trajectory:
    """Select these frames of a trajectory."""
    rows = np.flatnonzero(np.isin(trajectory.frame_ids, frame_ids))
    t, reasons = trajectory, tuple(trajectory.lost_reasons[r] for r in rows)
    return Trajectory(
        t.frame_ids[rows], t.timestamps[rows], t.cam_from_world[rows], t.is_keyframe[rows], reasons, t.by_rotation[rows]
    )


def interpolate_rows(
    wanted: NDArray[np.float64], times: NDArray[np.float64], values: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(Q, K) values at the wanted times between the given (N, K) ones."""
    order = np.argsort(times, kind="stable")
    columns = [np.interp(wanted, times[order], values[order, k]) for k in range(values.shape[1])]
    return np.stack(columns, axis=1).astype(np.float32)
