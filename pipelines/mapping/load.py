"""From the run folder to views: which frames the map is made from, and which only measure it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.config import ArticleConfig, MappingConfig
from pipelines.mapping.article.mirrors import Mirrors
from pipelines.mapping.depth_fields import Anchors
from pipelines.mapping.views import View, make_view, occurring_classes, working_size
from pipelines.run_folder import RunFolder
from pipelines.types import Frame, Intrinsics, ProxyMaps, Trajectory


@dataclass(frozen=True)
class MappingInput:
    """views: keyframes that make the map; held_out: frames that only measure it; class_ids: label of each channel."""

    views: list[View]
    held_out: list[View]
    class_ids: tuple[int, ...]
    anchors: Mapping[int, Anchors]


def load_views(
    run: RunFolder,
    trajectory: Trajectory,
    settings: MappingConfig,
    article: ArticleConfig | None = None,
    device: torch.device | str = "cpu",
) -> MappingInput:
    """The keyframes of `trajectory` with images and proxies, in order; proxies scaled to the world of tracking."""
    frames = {f.id: f for f in run.load_frames()}
    full = run.load_calibration().intrinsics
    intrinsics = working_size(full, settings.max_side)
    scales, symmetry = DepthScales.load(run), run.load_symmetry() if article and article.symmetry_weight > 0 else {}
    kept, measured = split_frames(trajectory, settings.hold_out)
    maps = {i: run.load_proxy(i) for i in kept + measured if run.has_proxy(i)}
    class_ids = occurring_classes([maps[i].labels for i in kept if i in maps])
    poses = dict(zip(trajectory.frame_ids.tolist(), trajectory.cam_from_world, strict=True))

    def load(frame_id: int) -> View:
        frame = frames[frame_id]
        scaled = scales.apply(frame_id, maps.get(frame_id))
        view = load_view(run, frame, intrinsics, poses[frame_id], scaled, class_ids, device)
        if frame_id not in symmetry:
            return view
        field = torch.from_numpy(scales.field(frame_id, tuple(view.depth.shape))).to(device)
        return replace(view, mirrors=Mirrors.of(symmetry[frame_id], full, intrinsics, device).scaled(field))

    return MappingInput([load(i) for i in kept], [load(i) for i in measured], class_ids, load_anchors(run, intrinsics))


def load_view(
    run: RunFolder,
    frame: Frame,
    intrinsics: Intrinsics,
    cam_from_world: NDArray[np.float64],
    maps: ProxyMaps | None,
    class_ids: tuple[int, ...],
    device: torch.device | str,
) -> View:
    """One frame as a view."""
    image, left_out = run.image(frame), run.left_out(frame)
    return make_view(frame.id, intrinsics, cam_from_world, image, maps, 1.0, class_ids, device, left_out)


def load_anchors(run: RunFolder, intrinsics: Intrinsics) -> dict[int, Anchors]:
    """The triangulated points of tracking in the pixels of every frame that sees them, by frame id."""
    model = run.load_sparse("tracking")
    full = run.load_calibration().intrinsics
    scale = np.array([intrinsics.width / full.width, intrinsics.height / full.height])
    out = {}
    for n, frame_id in enumerate(model.frame_ids.tolist()):
        mine = model.obs_frame == n
        points = model.points_in_world[model.obs_point[mine]]
        depth = points @ model.cam_from_world[n, 2, :3] + model.cam_from_world[n, 2, 3]
        out[frame_id] = Anchors(model.obs_xy[mine] * scale, depth)
    return out


def split_frames(trajectory: Trajectory, hold_out: int) -> tuple[list[int], list[int]]:
    """(ids of keyframes to use, ids of posed frames held out: every `hold_out`-th, from half of that on)."""
    posed = trajectory.frame_ids[trajectory.is_posed].tolist()
    keyframes = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    if hold_out <= 0:
        return keyframes, []
    held = [i for i in posed if i % hold_out == hold_out // 2]
    return [i for i in keyframes if i not in set(held)], held


@dataclass(frozen=True)
class DepthScales:
    """What tracking found: depth in the world = scale field x proxy depth. grids: frame id → (rows, columns) scales."""

    grids: Mapping[int, NDArray[np.float64]]

    @staticmethod
    def load(run: RunFolder) -> DepthScales:
        """From tracking/depth_scales.npz; without that file every proxy is in the unit of the world."""
        arrays = run.load_depth_scales()
        if arrays is None:
            return DepthScales({})
        grids = arrays["grids"] if "grids" in arrays else arrays["scales"][:, None, None]
        return DepthScales(dict(zip(arrays["frame_ids"].tolist(), grids, strict=True)))

    def field(self, frame_id: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """(H, W) the scale of every pixel, 1 for a frame of which tracking said nothing."""
        if frame_id not in self.grids:
            return np.ones(shape, np.float32)
        return scale_field(self.grids[frame_id], (shape[0], shape[1]))

    def apply(self, frame_id: int, maps: ProxyMaps | None) -> ProxyMaps | None:
        """The same maps with the depth in the unit of the world."""
        if maps is None or frame_id not in self.grids:
            return maps
        depth = maps.depth * self.field(frame_id, maps.depth.shape)
        return ProxyMaps(depth, maps.confidence, maps.labels, maps.label_confidence)


def scale_field(grid: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """(H, W) scales of every pixel: the log is bilinear between nodes that span the picture from corner to corner."""
    rows, columns = grid.shape
    height, width = shape
    x = (np.arange(width) + 0.5) / width * (columns - 1)
    y = (np.arange(height) + 0.5) / height * (rows - 1)
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    # remap interpolates between the pixels at integer places: the nodes.
    log_grid = np.log(grid).astype(np.float32)
    return np.exp(cv2.remap(log_grid, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
