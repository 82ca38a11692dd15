"""Conversion of pycolmap's reconstruction to the arrays that the other stages read."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import ModelArrays
from ..geometry.sparse_model import SparseModel
from .lens import Lens


def to_sparse_model(
    model: pycolmap.Reconstruction,
    keyframe_ids: Sequence[int],
    lens: Lens,
    load_rgb: Callable[[int], NDArray[np.uint8]],
) -> SparseModel:
    """Keyframes, points and observations in undistorted pixels.

    The world is the camera of the first registered keyframe, and its unit the median depth of all observations, or the
    model's own where there are none.
    keyframe_ids[i] is the frame id of the image with id i + 1; load_rgb(frame_id) gives (H, W, 3) of the frame before
    undistortion, one at a time.
    """
    found = ModelArrays.of(model)
    observed = [(found.obs_point[r], found.obs_xy[r]) for r in found.rows()]
    frame_ids = np.array([keyframe_ids[i - 1] for i in found.image_ids], dtype=np.int64)
    colors = _mean_colors(observed, len(found.points), (load_rgb(int(i)) for i in frame_ids))
    obs_xy = np.concatenate([lens.undistort_points(xy) for _, xy in observed])
    poses, points = _rebased(found.cam_from_world, found.points, found.obs_cam, found.obs_point)
    return SparseModel(frame_ids, poses, points, colors, found.obs_cam, found.obs_point, obs_xy)


def _mean_colors(
    observed: Iterable[tuple[NDArray[np.int64], NDArray[np.float64]]], count: int, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    total, seen = np.zeros((count, 3)), np.zeros(count)
    for (point, xy), rgb in zip(observed, images, strict=True):
        column = np.clip(xy[:, 0].astype(np.int64), 0, rgb.shape[1] - 1)
        line = np.clip(xy[:, 1].astype(np.int64), 0, rgb.shape[0] - 1)
        np.add.at(total, point, rgb[line, column])
        np.add.at(seen, point, 1)
    return np.round(total / np.maximum(seen, 1)[:, None]).astype(np.uint8)


def _rebased(
    cam_from_world: NDArray[np.float64],
    points: NDArray[np.float64],
    obs_frame: NDArray[np.int64],
    obs_point: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses and points with the first camera as the world, and the median depth as its unit."""
    first = cam_from_world[0]
    world_from_first = np.eye(4)
    world_from_first[:3, :3], world_from_first[:3, 3] = first[:3, :3].T, -first[:3, :3].T @ first[:3, 3]
    poses = cam_from_world @ world_from_first
    moved = points @ first[:3, :3].T + first[:3, 3]
    depth = (poses[obs_frame, 2, :3] * moved[obs_point]).sum(1) + poses[obs_frame, 2, 3]
    unit = float(np.median(depth)) if len(depth) else 1.0
    poses[:, :3, 3] /= unit
    poses[0] = np.eye(4)
    return poses, moved / unit
