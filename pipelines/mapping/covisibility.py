"""Which keyframes see the same, and how much each one counts (MSGS-SLAM eqs. 10, 13, 14)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.camera import project, unproject
from pipelines.mapping.views import View

_SAMPLES_ACROSS = 16


def overlaps(views: Sequence[View]) -> NDArray[np.float64]:
    """(N, N) η[i, j] of eq. (10): the fraction of view i's back-projected samples inside view j's image."""
    out = np.eye(len(views))
    poses = np.stack([v.cam_from_world.cpu().numpy() for v in views])
    for i, view in enumerate(views):
        points = _sampled_points(view)
        if len(points) == 0:
            continue
        for j, other in enumerate(views):
            xy, _ = project(points @ poses[j, :3, :3].T + poses[j, :3, 3], other.intrinsics)
            size = (other.intrinsics.width, other.intrinsics.height)
            # Pixels of points behind the camera are NaN, which compares false.
            out[i, j] = ((xy >= 0) & (xy < size)).all(1).mean()
    return out


def _sampled_points(view: View) -> NDArray[np.float64]:
    """(P, 3) points in the world on a coarse grid of the view's known depth."""
    stride = max(view.intrinsics.width // _SAMPLES_ACROSS, 1)
    depth = view.depth[stride // 2 :: stride, stride // 2 :: stride].cpu().numpy().astype(np.float64)
    rows, columns = np.nonzero(depth > 0)
    xy = np.stack([columns, rows], 1).astype(np.float64) * stride + (stride // 2 + 0.5)
    in_cam = unproject(xy, depth[rows, columns], view.intrinsics)
    world_from_cam = np.linalg.inv(view.cam_from_world.cpu().numpy())
    return in_cam @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]


def keyframe_weights(
    now: int, reliability: NDArray[np.float64], time_decay: float, reliability_decay: float
) -> NDArray[np.float64]:
    """(N,) eq. (13) with ρ = 1: exp(-τ (now - t)) exp(-δ (1 - mean U)), eq. (14); `reliability` (N,) is mean U."""
    age = np.maximum(now - np.arange(len(reliability)), 0)
    return np.exp(-time_decay * age) * np.exp(-reliability_decay * (1 - reliability))
