"""Map and trajectory follow keyframes that have moved: each Gaussian its anchor, each frame its neighbours in time."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import se3
from ..render.gaussian_map import GaussianMap
from ..types import Trajectory

Array = NDArray[np.float64]


def move_map(
    gaussian_map: GaussianMap,
    frame_ids: NDArray[np.int64],
    old_cam_from_world: Array,
    new_cam_from_world: Array,
    depth_ratio: Array,
) -> GaussianMap:
    """The map after its keyframes (N,) moved from old to new poses (N, 4, 4), their depths times `depth_ratio` (N,).

    A Gaussian keeps its place in its anchor's image; its distance and radius change by the ratio. Gaussians whose
    anchor is not among the keyframes follow the one next to it in the sequence.
    """
    anchors = gaussian_map.anchor_frame_ids.cpu().numpy()
    order = np.argsort(frame_ids, kind="stable")
    sorted_ids = frame_ids[order]
    place = np.clip(np.searchsorted(sorted_ids, anchors), 0, len(order) - 1)
    before = np.clip(place - 1, 0, None)
    nearer = np.abs(sorted_ids[before] - anchors) < np.abs(sorted_ids[place] - anchors)
    keyframe = order[np.where(nearer, before, place)]
    means = gaussian_map.means.detach().cpu().double().numpy()
    old, world_from_new = old_cam_from_world[keyframe], se3.inverse(new_cam_from_world)[keyframe]
    in_cam = np.einsum("mij,mj->mi", old[:, :3, :3], means) + old[:, :3, 3]
    in_cam *= depth_ratio[keyframe, None]
    moved = np.einsum("mij,mj->mi", world_from_new[:, :3, :3], in_cam) + world_from_new[:, :3, 3]
    device = gaussian_map.means.device
    return replace(
        gaussian_map,
        means=torch.from_numpy(moved).float().to(device),
        log_radii=gaussian_map.log_radii + torch.from_numpy(np.log(depth_ratio)[keyframe]).float().to(device),
    )


def follow_keyframes(
    frame_ids: NDArray[np.int64],
    cam_from_world: Array,
    keyframe_ids: NDArray[np.int64],
    old_keyframes: Array,
    new_keyframes: Array,
    ratio: Array,
) -> Array:
    """(F, 4, 4) poses of all frames (F,) after their keyframes moved: each goes with the two around it in time.

    A frame keeps its pose relative to each of the two, its distance stretched by `ratio` (N,), and takes the point of
    the screw motion between the two answers that its place in time says.
    """
    out = np.empty_like(cam_from_world)
    after = np.searchsorted(keyframe_ids, frame_ids)
    last = len(keyframe_ids) - 1
    for row, frame_id in enumerate(frame_ids):
        first, second = max(int(after[row]) - 1, 0), min(int(after[row]), last)
        answers = []
        for k in (first, second):
            relative = cam_from_world[row] @ se3.inverse(old_keyframes[k])
            relative[:3, 3] *= ratio[k]
            answers.append(relative @ new_keyframes[k])
        gap = float(keyframe_ids[second] - keyframe_ids[first])
        share = (float(frame_id) - float(keyframe_ids[first])) / gap if gap > 0 else 0.0
        share = min(max(share, 0.0), 1.0)
        out[row] = se3.exp(share * se3.log(answers[1] @ se3.inverse(answers[0]))) @ answers[0]
    return out


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


def interpolate_rows(
    wanted: NDArray[np.float64], times: NDArray[np.float64], values: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(Q, K) values at the wanted times between the given (N, K) ones."""
    order = np.argsort(times, kind="stable")
    columns = [np.interp(wanted, times[order], values[order, k]) for k in range(values.shape[1])]
    return np.stack(columns, axis=1).astype(np.float32)
