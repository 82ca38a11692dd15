"""Render-and-compare: the pose of a frame against Gaussians seeded from the keyframes around it (MSGS-SLAM eq. 16).

The working map is made for each frame anew from its nearest keyframes' proxy depths and thrown away after: no map of
the whole scene has to be there yet, and memory does not grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.config import TrackingConfig
from pipelines.gaussians.map import GaussianMap
from pipelines.gaussians.render import render, track_gn
from pipelines.gaussians.seeding import seed_gaussians, seed_grid
from pipelines.tracking.depth_scales import keyframe_scale, sample_proxy
from pipelines.tracking.pictures import Pictures
from pipelines.tracking.state import TrackState
from pipelines.types import Intrinsics

Array = NDArray[np.float64]
WORKING_SIDE = 320
"""Long side of the pictures that are compared: smaller ones have a wider basin, and colours there are averages."""
STRIDE = 2


@dataclass(frozen=True)
class Comparison:
    """cam_from_world (4, 4) after the comparison, eq. (16) per pixel before and after, and the mean absolute deviation
    of the picture's colours: what a map would leave that knows nothing but the mean."""

    cam_from_world: Array
    loss_before: float
    loss_after: float
    contrast: float

    @property
    def is_better(self) -> bool:
        """Whether the loss fell."""
        return self.loss_after < self.loss_before

    @property
    def unexplained(self) -> float:
        """Share of the contrast that is left; 1 and more for a picture of something else, or of nothing."""
        return self.loss_after / max(self.contrast, 1e-6)


def compare_frame(
    frame_id: int,
    start: Array,
    keyframes: list[int],
    state: TrackState,
    pictures: Pictures,
    intrinsics: Intrinsics,
    settings: TrackingConfig,
) -> Comparison | None:
    """The pose near `start` (4, 4) from which the working map looks most like the frame.

    None where the keyframes have no depth, too little of the map is seen, or the search does not converge. The
    keyframes lie in one segment.
    """
    small = _working_camera(intrinsics)
    seeds = [s for k in keyframes if (s := seed_keyframe(k, state, pictures, intrinsics, small)) is not None]
    if not seeds:
        return None
    means, radii, opacities, colors = (torch.cat(parts) for parts in zip(*map(_plain, seeds), strict=True))
    image = _picture(pictures.color(frame_id), small)
    pose = torch.from_numpy(np.ascontiguousarray(start))
    before, gain, bias = photometric_loss(means, radii, opacities, colors, pose, small, image, settings)
    fit = track_gn(
        means, radii, opacities, colors, pose, small, ((image - bias) / gain).clamp(0, 1),
        min_silhouette=settings.silhouette, color_weight=settings.color_weight,
    )  # fmt: skip
    if not fit.converged or not np.isfinite(before):
        return None
    after, _, _ = photometric_loss(means, radii, opacities, colors, fit.cam_from_world, small, image, settings)
    contrast = settings.color_weight * float((image - image.mean((0, 1))).abs().mean())
    return Comparison(fit.cam_from_world.numpy(), before, after, contrast)


def seed_keyframe(
    keyframe: int, state: TrackState, pictures: Pictures, intrinsics: Intrinsics, small: Intrinsics
) -> GaussianMap | None:
    """Gaussians at a keyframe's proxy depth, scaled to agree with the points it sees; None without depth."""
    maps = pictures.proxy(keyframe)
    if maps is None:
        return None
    seen, motion = state.sightings[keyframe], state.poses[keyframe]
    known, trust = sample_proxy(maps, seen.xy, intrinsics)
    z = state.points[seen.point] @ motion[2, :3] + motion[2, 3]
    both = (known > 0) & (z > 0)
    scale = np.exp(keyframe_scale(np.log(z[both] / known[both]), trust[both])) if both.sum() >= 8 else 1.0
    size = (small.width, small.height)
    depth = cv2.resize(maps.depth, size, interpolation=cv2.INTER_NEAREST) * np.float32(scale)
    grid = torch.from_numpy(seed_grid(small.height, small.width, STRIDE))
    no_classes = torch.zeros(grid.shape, dtype=torch.uint8)
    colors = _picture(pictures.color(keyframe), small)
    pose = torch.from_numpy(np.ascontiguousarray(motion))
    return seed_gaussians(grid, torch.from_numpy(depth), colors, no_classes, STRIDE, 1, pose, small, keyframe)


@torch.no_grad()
def photometric_loss(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    colors: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    image: Tensor,
    settings: TrackingConfig,
) -> tuple[float, Tensor, Tensor]:
    """λ_C |I - C| of eq. (16) per pixel with Sil > T_sil, after the exposure (gain (3,), bias (3,)) that fits best.

    Infinite when less than a fifth of the picture shows the map. Frames between keyframes have no proxies, so that the
    terms of depth and labels are empty here.
    """
    drawn = render(means, radii, opacities, colors, cam_from_world, intrinsics)
    inside = drawn.silhouette > settings.silhouette
    ones, zeros = torch.ones(3), torch.zeros(3)
    if inside.float().mean() < 0.2:
        return float("inf"), ones, zeros
    ours, theirs = drawn.features[..., :3][inside].double(), image[inside].double()
    centred = ours - ours.mean(0)
    gain = (centred * (theirs - theirs.mean(0))).sum(0) / centred.square().sum(0).clamp(min=1e-9)
    gain = gain.clamp(0.5, 2.0)
    bias = theirs.mean(0) - gain * ours.mean(0)
    loss = settings.color_weight * float((ours * gain + bias - theirs).abs().mean())
    return loss, gain.float(), bias.float()


def _plain(seeds: GaussianMap) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return seeds.means, seeds.radii, seeds.opacities, seeds.colors


def _picture(image: NDArray[np.uint8], small: Intrinsics) -> Tensor:
    """(h, w, 3) float32 0..1 at the working size."""
    reduced = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(reduced.astype(np.float32) / 255)


def _working_camera(intrinsics: Intrinsics) -> Intrinsics:
    factor = min(WORKING_SIDE / max(intrinsics.width, intrinsics.height), 1.0)
    return intrinsics.resized(round(intrinsics.width * factor), round(intrinsics.height * factor))
