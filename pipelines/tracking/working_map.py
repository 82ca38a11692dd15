"""The two sides of render-and-compare: Gaussians seeded from a few keyframes, and a frame with what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from msgs_slam.pipelines.depth.resize import resize_maps
from msgs_slam.pipelines.depth.scales import scale_at_points
from msgs_slam.pipelines.gaussians.seeding import seed_gaussians, seed_grid
from msgs_slam.pipelines.proxy.palette import class_colors
from msgs_slam.pipelines.tracking.pictures import Pictures
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.types import VOID, Intrinsics, ProxyMaps

Array = NDArray[np.float64]
WORKING_SIDE = 320
"""Long side of the images that are compared: smaller ones have a wider basin, and colours there are averages."""
STRIDE = 2
MIN_POINTS = 8
"""Fewer points say nothing of the scale of a proxy depth."""


@dataclass(frozen=True)
class WorkingMap:
    """M Gaussians: means (M, 3), radii (M,), opacities (M,), colors (M, 3), labels (M, 3): the colour of the class."""

    means: Tensor
    radii: Tensor
    opacities: Tensor
    colors: Tensor
    labels: Tensor


@dataclass(frozen=True)
class View:
    """A frame at the working size h x w.

    image (h, w, 3) 0..1; depth (h, w) in the world's unit, 0 = unknown, and its reliability U (h, w); unit: the median
    of the depth, 1 without any; labels (h, w, 3): the colours of the classes; None without proxies.
    """

    image: Tensor
    depth: Tensor
    reliability: Tensor
    unit: float
    labels: Tensor | None


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
    scale = proxy_scale(keyframe, motion, maps, state, pictures.intrinsics) or 1.0
    maps = resize_maps(maps, small.height, small.width)
    depth = maps.depth * np.float32(scale)
    grid = torch.from_numpy(seed_grid(small.height, small.width, STRIDE))
    channels = torch.from_numpy(maps.labels)
    colors, pose = _picture(pictures.color(keyframe), small), torch.from_numpy(np.ascontiguousarray(motion))
    seeds = seed_gaussians(grid, torch.from_numpy(depth), colors, channels, STRIDE, 1, pose, small, keyframe)
    classes = channels[grid & torch.from_numpy(depth > 0)]
    return seeds.means, seeds.radii, seeds.opacities, seeds.colors, _class_picture(classes)


def view_of(frame_id: int, cam_from_world: Array, keyframes: list[int], state: TrackState, pictures: Pictures) -> View:
    """The frame, its proxy depth scaled by the points it sees or, without enough of them, as the keyframes' is."""
    camera, maps = pictures.intrinsics, pictures.proxy(frame_id)
    small = camera.at_most(WORKING_SIDE)
    image = _picture(pictures.color(frame_id), small)
    if maps is None:
        nothing = torch.zeros(small.height, small.width)
        return View(image, nothing, nothing, 1.0, None)
    scale = proxy_scale(frame_id, cam_from_world, maps, state, camera)
    if scale is None:
        near = [(k, m) for k in keyframes if (m := pictures.proxy(k)) is not None]
        scales = [s for k, m in near if (s := proxy_scale(k, state.poses[k], m, state, camera)) is not None]
        scale = float(np.exp(np.mean(np.log(scales)))) if scales else 1.0
    maps = resize_maps(maps, small.height, small.width)
    depth = maps.depth * np.float32(scale)
    unit = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    labels = _class_picture(torch.from_numpy(maps.labels))
    return View(image, torch.from_numpy(depth), torch.from_numpy(maps.confidence), unit, labels)


def proxy_scale(
    frame_id: int, cam_from_world: Array, maps: ProxyMaps, state: TrackState, intrinsics: Intrinsics
) -> float | None:
    """World over proxy depth: the median over the points that the frame sees; None for fewer than eight."""
    if frame_id not in state.sightings:
        return None
    seen = state.sightings[frame_id]
    z = state.points[seen.point] @ cam_from_world[2, :3] + cam_from_world[2, 3]
    return scale_at_points(maps, seen.xy, z, intrinsics, MIN_POINTS)


def _class_picture(labels: Tensor) -> Tensor:
    """(..., 3) 0..1 colours of labels (...), black for VOID; not the table's, which may be alike."""
    table = torch.zeros(VOID + 1, 3)
    table[:VOID] = torch.tensor(class_colors(VOID)) / 255
    return table[labels.long()]


def _picture(image: NDArray[np.uint8], small: Intrinsics) -> Tensor:
    """(h, w, 3) float32 0..1 at the working size."""
    reduced = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(reduced.astype(np.float32) / 255)
