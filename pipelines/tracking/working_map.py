"""The two sides of render-and-compare: Gaussians seeded from a few keyframes, and a frame at their size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..depth.align import scale_at_points
from ..geometry.resampling import resize_maps
from ..render.seeding import seed_gaussians, seed_grid
from ..types import Intrinsics
from .pictures import Pictures
from .state import TrackState

Array = NDArray[np.float64]
WORKING_SIDE = 320
"""Long side of the images that are compared: smaller ones have a wider basin, and colours there are averages."""
STRIDE = 2
MIN_POINTS = 8
"""Fewer points say nothing of the scale of a proxy depth."""


@dataclass(frozen=True)
class WorkingMap:
    """M Gaussians: means (M, 3), radii (M,), opacities (M,), colors (M, 3)."""

    means: Tensor
    radii: Tensor
    opacities: Tensor
    colors: Tensor


def seed_map(keyframes: list[int], state: TrackState, pictures: Pictures) -> WorkingMap | None:
    """Gaussians at the keyframes' proxy depths, each scaled to agree with the points it sees; None without depth."""
    parts = [p for k in keyframes if (p := _seed_keyframe(k, state, pictures)) is not None]
    if not parts:
        return None
    return WorkingMap(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


def _seed_keyframe(keyframe: int, state: TrackState, pictures: Pictures) -> tuple[Tensor, ...] | None:
    maps = pictures.proxy(keyframe)
    if maps is None:
        return None
    small, motion = pictures.intrinsics.at_most(WORKING_SIDE), state.poses[keyframe]
    points = state.sightings[keyframe].xy, state.depths(keyframe)
    scale = scale_at_points(maps, *points, pictures.intrinsics, MIN_POINTS) or 1.0
    maps = resize_maps(maps, small.height, small.width)
    depth = maps.depth * np.float32(scale)
    grid = torch.from_numpy(seed_grid(small.height, small.width, STRIDE))
    channels = torch.from_numpy(maps.labels)
    colors, pose = reduced_image(pictures.color(keyframe), small), torch.from_numpy(np.ascontiguousarray(motion))
    seeds = seed_gaussians(grid, torch.from_numpy(depth), colors, channels, STRIDE, 1, pose, small, keyframe)
    return seeds.means, seeds.radii, seeds.opacities, seeds.colors


def reduced_image(image: NDArray[np.uint8], small: Intrinsics) -> Tensor:
    """(h, w, 3) float32 0..1 at the working size."""
    reduced = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(reduced.astype(np.float32) / 255)
