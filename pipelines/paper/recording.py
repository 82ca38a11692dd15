"""Frames of a run as views with the proxies as they were given, and the results of the paper's method in its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..depth.fields import DepthFields
from ..engine.stages import StageContext
from ..geometry import se3
from ..geometry.camera import project
from ..geometry.sparse_model import SparseModel
from ..mapping.load import load_view, survey
from ..mapping.views import View
from ..render.gaussian_map import GaussianMap
from ..run.files import CALIBRATION, FRAMES
from ..system.memory import VIEWS_SHARE
from ..system.parallel import LruSequence
from ..types import Frame, Intrinsics, Trajectory
from .gaussians import scaled_depth
from .uncertainty import proxy_depth

WORKING_SIDE = 320
"""Pixels on the long side of the images that frames are tracked with and the map is grown from."""
_POINTS = 200
"""Points that stand for a keyframe's Gaussians in the sparse model, for programs that want one."""


class Recording:
    """The frames of a run, as views at a size; `held`: ids of those that only measure the map."""

    def __init__(self, context: StageContext, side: int = WORKING_SIDE) -> None:
        run, memory = context.run, context.memory_room
        self.frames: list[Frame] = run.load(FRAMES)
        self.full: Intrinsics = run.load(CALIBRATION).intrinsics
        self.camera = self.full.at_most(side)
        every = context.config.mapping.hold_out
        self.held = {f.id for f in self.frames if every > 0 and f.id % every == every // 2}
        self.class_ids, self.with_depth = survey(run, [f.id for f in self.frames if f.id not in self.held])
        at = np.eye(4)

        def load(i: int) -> View:
            maps = proxy_depth(run, i)
            return load_view(run, self.frames[i], self.camera, at, maps, self.class_ids, "cpu")

        self.views: LruSequence[View] = LruSequence(len(self.frames), load, lambda v: v.nbytes, VIEWS_SHARE * memory)

    def scaled(self, frame_id: int, fields: DepthFields) -> View:
        """Return a frame's view with its proxy depth brought into the world by its field."""
        view = self.views[frame_id]
        return scaled_depth(view, torch.from_numpy(fields.scales(frame_id, *view.depth.shape)))


def trajectory_of(
    frames: Sequence[Frame], poses: Mapping[int, Tensor], keyframes: Sequence[int], lost: Mapping[int, str]
) -> Trajectory:
    """Collect the poses (4, 4) by frame id."""
    known, keys = [f.id in poses for f in frames], set(keyframes)
    return Trajectory(
        np.array([f.id for f in frames]),
        np.array([f.timestamp for f in frames]),
        np.array([poses[f.id].numpy() if f.id in poses else np.eye(4) for f in frames]),
        np.array([f.id in keys for f in frames]),
        tuple(
            "" if k else lost.get(f.id, "before the first frame with a depth")
            for f, k in zip(frames, known, strict=True)
        ),
    )


def sparse_model(gaussian_map: GaussianMap, trajectory: Trajectory, camera: Intrinsics) -> SparseModel:
    """Some of each keyframe's Gaussians as points that it observes."""
    ids = trajectory.frame_ids[trajectory.is_keyframe]
    poses = trajectory.cam_from_world[trajectory.is_keyframe]
    anchors, means = gaussian_map.anchor_frame_ids.numpy(), gaussian_map.means.double().numpy()
    rows, frame, xy = [], [], []
    for n, (frame_id, pose) in enumerate(zip(ids.tolist(), poses, strict=True)):
        own = np.flatnonzero(anchors == frame_id)
        own = own[:: max(len(own) // _POINTS, 1)]
        seen, z = project(se3.transform(pose, means[own]), camera)
        inside = (z > 0) & (seen > 0).all(1) & (seen < [camera.width, camera.height]).all(1)
        rows.append(own[inside])
        frame.append(np.full(int(inside.sum()), n))
        xy.append(seen[inside])
    chosen: NDArray[np.int64] = np.concatenate(rows)
    colors = (gaussian_map.colors[torch.from_numpy(chosen)].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    points = np.arange(len(chosen))
    return SparseModel(ids, poses, means[chosen], colors, np.concatenate(frame), points, np.concatenate(xy))
