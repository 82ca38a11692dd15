"""Helpers: a short walk through the synthetic room, with the backbone that perfect structure from motion would give."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.types import Calibration, Frame, Intrinsics
from tests.world import WorldFrame

UNIT = 0.5
"""The backbone's unit is two metres: nothing may take it for metres."""


@dataclass(frozen=True)
class Room:
    """Rendered frames, their camera, and the backbone in its own unit."""

    views: list[WorldFrame]
    frames: list[Frame]
    calibration: Calibration
    backbone: SparseModel

    def sequence(self, max_side: int = 640) -> Sequence:
        return Sequence(
            self.frames,
            self.calibration,
            self.calibration.intrinsics.at_most(max_side),
            self.backbone,
            lambda frame: self.views[frame.id].rgb,
        )


def perfect_backbone(views: list[WorldFrame], camera: Intrinsics) -> SparseModel:
    cams = np.array([np.linalg.inv(v.world_from_cam) for v in views])
    v, u = np.mgrid[6 : camera.height : 14, 6 : camera.width : 14]
    points = []
    for view in views[::2]:
        rays = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        inside = view.depth[v, u] > 0
        in_cam = (rays * view.depth[v, u][..., None])[inside]
        points.append(in_cam @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3])
    cloud = np.concatenate(points)
    rows: list[tuple[NDArray, NDArray, NDArray]] = []
    for i, (view, cam) in enumerate(zip(views, cams, strict=True)):
        xy, z = project(cloud @ cam[:3, :3].T + cam[:3, 3], camera)
        ok = (z > 0) & (xy > 0).all(1) & (xy < [camera.width, camera.height]).all(1)
        at = np.where(ok[:, None], xy, 0).astype(int)
        ok &= np.abs(view.depth[at[:, 1], at[:, 0]] - z) < 0.02 * np.abs(z)
        ids = np.flatnonzero(ok)
        rows.append((np.full(len(ids), i), ids, xy[ids]))
    scaled = cams.copy()
    scaled[:, :3, 3] *= UNIT
    obs_frame, obs_point, obs_xy = (np.concatenate(c) for c in zip(*rows, strict=True))
    colors = np.zeros((len(cloud), 3), np.uint8)
    return SparseModel(np.arange(len(views)), scaled, cloud * UNIT, colors, obs_frame, obs_point, obs_xy)


def write_source(room: Room, folder: Path) -> Path:
    for frame in room.frames:
        view = room.views[frame.id]
        write_rgb(folder / "rgb" / frame.name, view.rgb)
        write_grey_png(folder / "depth" / frame.name, np.round(view.depth * 1000).astype(np.uint16))
        write_grey_png(folder / "labels" / frame.name, view.labels)
    ids = np.unique([np.unique(v.labels) for v in room.views[:1]])
    classes = [{"id": 0, "name": "none"}] + [{"id": int(i), "name": f"kind {i}"} for i in range(1, max(ids.max(), 40))]
    write_json(folder / "classes.json", {"classes": classes})
    return folder / "rgb"
