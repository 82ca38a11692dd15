"""Render-and-compare: the pose of a frame against Gaussians seeded from the keyframes around it (MSGS-SLAM eq. 16).

The working map is made for each frame anew from its nearest keyframes' proxy depths and thrown away after: no map of
the whole scene has to be there yet, and memory does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.pipelines.config import PaperConfig
from msgs_slam.pipelines.gaussians.render import render, track_gn
from msgs_slam.pipelines.tracking.pictures import Pictures
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.tracking.working_map import WORKING_SIDE, View, WorkingMap, seed_map, view_of
from msgs_slam.pipelines.types import Intrinsics

Array = NDArray[np.float64]


SILHOUETTE = 0.95
"""T_sil of eq. (16): pixels that the map covers less do not count."""


@dataclass(frozen=True)
class RenderWeights:
    """λ_C, λ_D and λ_S of eq. (16), depths in units of the image's median depth."""

    color: float = 1.0
    depth: float = 0.0
    label: float = 0.0

    @staticmethod
    def of(paper: PaperConfig) -> RenderWeights:
        """Take the weights from the settings."""
        return RenderWeights(depth=paper.tracking_depth_weight, label=paper.tracking_label_weight)


@dataclass(frozen=True)
class Comparison:
    """cam_from_world (4, 4) after the comparison, and eq. (16) per pixel before and after.

    unexplained: share of the image's contrast that is left in the colours, 1 being what a map would leave that knows
    nothing but the mean; 1 and more for an image of something else, or of nothing.
    """

    cam_from_world: Array
    loss_before: float
    loss_after: float
    unexplained: float

    @property
    def is_better(self) -> bool:
        """Whether the loss fell."""
        return self.loss_after < self.loss_before


@dataclass(frozen=True)
class Loss:
    """Eq. (16) per pixel, its share of colour, and the exposure (gain (3,), bias (3,)) that fits best."""

    total: float
    color: float
    gain: Tensor
    bias: Tensor


def compare_frame(
    frame_id: int,
    start: Array,
    keyframes: list[int],
    state: TrackState,
    pictures: Pictures,
    weights: RenderWeights,
) -> Comparison | None:
    """The pose near `start` (4, 4) from which the working map looks most like the frame.

    None where the keyframes have no depth, too little of the map is seen, or the search does not converge. The
    keyframes are in one segment. The terms of depth and labels need proxies of the frame itself (`proxy.frames`).
    """
    small = pictures.intrinsics.at_most(WORKING_SIDE)
    drawn = seed_map(keyframes, state, pictures)
    if drawn is None:
        return None
    view = view_of(frame_id, start, keyframes, state, pictures)
    pose = torch.from_numpy(np.ascontiguousarray(start))
    before = tracking_loss(drawn, pose, small, view, weights)
    exposed = replace(view, image=((view.image - before.bias) / before.gain).clamp(0, 1))
    fit = track_gn(
        drawn.means, drawn.radii, drawn.opacities, drawn.colors, pose, small, exposed.image, view.depth,
        view.reliability, weights.color, weights.depth / view.unit, SILHOUETTE,
        labels=None if view.labels is None else (drawn.labels, view.labels), label_weight=weights.label,
    )  # fmt: skip
    if not fit.converged or not np.isfinite(before.total):
        return None
    after = tracking_loss(drawn, fit.cam_from_world, small, view, weights)
    contrast = float((view.image - view.image.mean((0, 1))).abs().mean())
    return Comparison(fit.cam_from_world.numpy(), before.total, after.total, after.color / max(contrast, 1e-6))


@torch.no_grad()
def tracking_loss(
    drawn: WorkingMap, cam_from_world: Tensor, intrinsics: Intrinsics, view: View, weights: RenderWeights
) -> Loss:
    """Eq. (16) over the pixels with Sil > T_sil, depths in units of the image's median depth.

    The colours are compared after the exposure that fits best. Infinite when less than a fifth of the image shows the
    map.
    """
    features = torch.cat([drawn.colors, drawn.labels], 1)
    image = render(drawn.means, drawn.radii, drawn.opacities, features, cam_from_world, intrinsics)
    inside = image.silhouette > SILHOUETTE
    ones, zeros = torch.ones(3), torch.zeros(3)
    if inside.float().mean() < 0.2:
        return Loss(float("inf"), float("inf"), ones, zeros)
    ours, theirs = image.features[..., :3][inside].double(), view.image[inside].double()
    centred = ours - ours.mean(0)
    gain = (centred * (theirs - theirs.mean(0))).sum(0) / centred.square().sum(0).clamp(min=1e-9)
    gain = gain.clamp(0.5, 2.0)
    bias = theirs.mean(0) - gain * ours.mean(0)
    color = float((ours * gain + bias - theirs).abs().mean())
    weight = (view.reliability * (view.depth > 0))[inside]
    depth = float((weight * (image.depth - view.depth)[inside].abs()).mean()) / view.unit
    label = 0.0
    if view.labels is not None:
        label = float((image.features[..., 3:] - view.labels)[inside].abs().mean())
    total = weights.color * color + weights.depth * depth + weights.label * label
    return Loss(total, color, gain.float(), bias.float())
