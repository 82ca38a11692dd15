"""Render-and-compare: the pose of a frame against Gaussians seeded from the keyframes around it (MSGS-SLAM eq. 16).

The working map is made for each frame anew from its nearest keyframes' proxy depths and thrown away after: no map of
the whole scene has to be there yet, and memory does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..render.api import render
from ..render.tracking import track_gn
from ..types import Intrinsics
from .pictures import Pictures
from .state import TrackState
from .working_map import WORKING_SIDE, WorkingMap, reduced_image, seed_map

Array = NDArray[np.float64]


SILHOUETTE = 0.95
"""T_sil of eq. (16): pixels that the map covers less do not count."""


@dataclass(frozen=True)
class Comparison:
    """cam_from_world (4, 4) after the comparison, and eq. (16), colours alone, per pixel before and after.

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
    """Mean colour difference of the pixels compared, and the exposure (gain (3,), bias (3,)) that fits best."""

    color: float
    gain: Tensor
    bias: Tensor


def compare_frame(
    frame_id: int, start: Array, keyframes: list[int], state: TrackState, pictures: Pictures
) -> Comparison | None:
    """The pose near `start` (4, 4) from which the working map looks most like the frame.

    None where the keyframes have no depth, too little of the map is seen, or the search does not converge. The
    keyframes are in one segment.
    """
    small = pictures.intrinsics.at_most(WORKING_SIDE)
    drawn = seed_map(keyframes, state, pictures)
    if drawn is None:
        return None
    image = reduced_image(pictures.color(frame_id), small)
    pose = torch.from_numpy(np.ascontiguousarray(start))
    before = tracking_loss(drawn, pose, small, image)
    exposed = ((image - before.bias) / before.gain).clamp(0, 1)
    fit = track_gn(
        drawn.means, drawn.radii, drawn.opacities, drawn.colors, pose, small, exposed, min_silhouette=SILHOUETTE
    )
    if not fit.converged or not np.isfinite(before.color):
        return None
    after = tracking_loss(drawn, fit.cam_from_world, small, image)
    contrast = float((image - image.mean((0, 1))).abs().mean())
    return Comparison(fit.cam_from_world.numpy(), before.color, after.color, after.color / max(contrast, 1e-6))


@torch.no_grad()
def tracking_loss(drawn: WorkingMap, cam_from_world: Tensor, intrinsics: Intrinsics, image: Tensor) -> Loss:
    """The colours of eq. (16) over the pixels of `image` (h, w, 3) with Sil > T_sil, after the exposure that fits best.

    Infinite when less than a fifth of the image shows the map. The paper's terms of depth and labels, tried on frames
    with proxies of their own, gained 0.02 cm and are left out; so is comparing frames that correspondences have posed
    (ATE 0.41 became 0.87 cm).
    """
    shown = render(drawn.means, drawn.radii, drawn.opacities, drawn.colors, cam_from_world, intrinsics)
    inside = shown.silhouette > SILHOUETTE
    ones, zeros = torch.ones(3), torch.zeros(3)
    if inside.float().mean() < 0.2:
        return Loss(float("inf"), ones, zeros)
    ours, theirs = shown.features[inside].double(), image[inside].double()
    centred = ours - ours.mean(0)
    gain = (centred * (theirs - theirs.mean(0))).sum(0) / centred.square().sum(0).clamp(min=1e-9)
    gain = gain.clamp(0.5, 2.0)
    bias = theirs.mean(0) - gain * ours.mean(0)
    color = float((ours * gain + bias - theirs).abs().mean())
    return Loss(color, gain.float(), bias.float())
