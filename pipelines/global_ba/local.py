"""The local semantic adjustment of a loop's keyframes, MSGS-SLAM eq. (25): poses by labels and depth, the map held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.gaussian_map import GaussianMap
from msgs_slam.pipelines.gaussians.adam import AdamTable, gradients_of
from msgs_slam.pipelines.gaussians.render import render
from msgs_slam.pipelines.gaussians.render.rendering import beside
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.global_ba.verify import Loop
from msgs_slam.pipelines.mapping import losses
from msgs_slam.pipelines.mapping.optimise import scene_depth
from msgs_slam.pipelines.mapping.paper.label_image import label_image_loss
from msgs_slam.pipelines.mapping.views import View

_RATE = 1e-3
"""Of Adam, rotations in radians and translations in units of the world; the paper has 3e-3 for its tracking."""
_POSE_WEIGHT = 100.0
"""Of the squared twist: a hundredth of the depth away costs as much as a hundredth of the depth's error."""
_LABEL_WEIGHT = 0.1
"""λ_S."""
_AROUND = 2
"""Keyframes to either side of each end of a loop that are adjusted with it."""


def loop_keyframes(loops: Sequence[Loop], keyframe_ids: Sequence[int]) -> set[int]:
    """Frame ids of the keyframes at both ends of the loops, and of those beside them."""
    place = {frame_id: n for n, frame_id in enumerate(keyframe_ids)}
    ends = {place[i] for loop in loops for i in (loop.edge.frame1_id, loop.edge.frame2_id)}
    return {k for n in ends for k in keyframe_ids[max(n - _AROUND, 0) : n + _AROUND + 1]}


def adjusted_poses(
    views: Sequence[View], gaussian_map: GaussianMap, settings: MappingConfig, steps: int
) -> dict[int, NDArray[np.float64]]:
    """Frame id → the pose that best explains labels and depth of a view, near where it was; one view in memory at a
    time. A pose that explains them no better than before stays."""
    unit = scene_depth(views)
    return {v.frame_id: _adjusted(v, gaussian_map, settings, steps, unit) for v in views}


def _adjusted(
    view: View, gaussian_map: GaussianMap, settings: MappingConfig, steps: int, unit: float
) -> NDArray[np.float64]:
    weight = losses.depth_weight(view.trust)
    table = AdamTable({"twist": torch.zeros(6)})
    best, pose = float("inf"), view.cam_from_world
    for _ in range(steps + 1):
        twist = table.values["twist"]
        shown = render(
            gaussian_map.means, gaussian_map.radii, gaussian_map.opacities, gaussian_map.class_logits,
            view.cam_from_world, view.intrinsics, twist=twist,
        )  # fmt: skip
        loss = settings.depth_weight * losses.depth_loss(shown.depth, view.depth, weight, unit)
        loss = loss + _LABEL_WEIGHT * label_image_loss(shown.features, view.channels, view.label_weight)
        away = (twist[:3] / unit).square().sum() + twist[3:].square().sum()
        loss = loss + _POSE_WEIGHT * beside(away, loss)
        if (value := float(loss.detach())) < best:
            best, pose = value, se3.exp(twist.detach().double()) @ view.cam_from_world
        (gradient,) = gradients_of(loss, (table.values,))
        table.step(gradient, {"twist": _RATE})
    return pose.numpy()
