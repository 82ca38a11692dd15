"""Depth provider: interpolation between the triangulated points that structure from motion left."""

import numpy as np
from scipy.interpolate import LinearNDInterpolator

from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.providers import DepthEstimate, DepthProvider
from msgs_slam.pipelines.proxy.selection import ProviderContext
from msgs_slam.pipelines.types import Frame


class PointsDepth(DepthProvider):
    """Inverse depth is linear between points in the picture, as it is on any plane."""

    name = "points"
    metric = False  # in the unit of the backbone's poses

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence

    def missing(self, frames: list[Frame]) -> list[Frame]:
        return [f for f in frames if f.id not in self._sequence.cam_from_world]

    def estimate(self, frame: Frame) -> DepthEstimate:
        model, camera = self._sequence.backbone, self._sequence.intrinsics
        depth = np.zeros((camera.height, camera.width), np.float32)
        if model is None or frame.id not in self._sequence.cam_from_world:
            return DepthEstimate(depth, depth)
        seen = model.frame_ids[model.obs_frame] == frame.id
        points = model.points_in_world[model.obs_point[seen]]
        cam_from_world = self._sequence.cam_from_world[frame.id]
        z = points @ cam_from_world[2, :3] + cam_from_world[2, 3]
        # Observations are in pixels of the frame, the maps may be smaller.
        xy = model.obs_xy[seen] * camera.width / self._sequence.calibration.intrinsics.width
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        inverse = LinearNDInterpolator(xy[z > 0], 1 / z[z > 0], fill_value=0)(columns, rows)
        np.divide(1, inverse, out=depth, where=inverse > 0, casting="unsafe")
        return DepthEstimate(depth, np.where(depth > 0, np.float32(0.5), np.float32(0)))


def open_points(around: ProviderContext) -> PointsDepth:
    """What goes into the table of providers."""
    return PointsDepth(around.sequence)
