"""Length of the backbone's unit in the unit of a depth: metres per unit when the depth is metric."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..providers import DepthEstimate, Sequence
from ..types import Frame

_MIN_POINTS = 20


@dataclass(frozen=True)
class DepthScale:
    """Depth over the depth of the backbone's points: of each frame, and their median over the run.

    spread_in: how far, relatively and robustly, a frame's own points stray from its scale.
    """

    of_frame: dict[int, float]
    spread_in: dict[int, float] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """The scale of the run; 1 where nothing is known."""
        return float(np.median(list(self.of_frame.values()))) if self.of_frame else 1.0

    def in_backbone_unit(self, estimate: DepthEstimate) -> DepthEstimate:
        """Convert a depth to the unit of the backbone's poses."""
        return replace(estimate, depth=(estimate.depth / np.float32(self.value)).astype(np.float32))

    @property
    def spread(self) -> float:
        """Relative standard deviation over the frames, robust."""
        values = np.array(list(self.of_frame.values()))
        return 1.4826 * float(np.median(np.abs(values / self.value - 1))) if len(values) else 0.0


def measure_scale(sequence: Sequence, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> DepthScale:
    """Compare the depth of every frame with the points it observes; frames with too few points do not count."""
    of_frame, spread_in = {}, {}
    for frame in frames:
        if frame.id in sequence.cam_from_world:
            depth, z = depth_at_points(sequence, frame, depth_of(frame).depth)
            if len(z) >= _MIN_POINTS:
                of_frame[frame.id] = float(np.median(depth / z))
                spread_in[frame.id] = 1.4826 * float(np.median(np.abs(depth / z / of_frame[frame.id] - 1)))
    return DepthScale(of_frame, spread_in)


def depth_at_points(
    sequence: Sequence, frame: Frame, depth: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(Q,) values of a depth image (h, w) where the backbone's points are seen, without unknown ones, and (Q,) the
    depths of those points in the backbone's unit; nothing for a frame without a pose."""
    model, camera = sequence.backbone, sequence.intrinsics
    if model is None or frame.id not in sequence.cam_from_world:
        return np.empty(0), np.empty(0)
    index = int(np.flatnonzero(model.frame_ids == frame.id)[0])
    points = model.points_in_world[model.obs_point[model.observations_of(index)]]
    cam_from_world = model.cam_from_world[index]
    xy, z = project(points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], camera)
    ok = (z > 0) & (xy > 0).all(1) & (xy < [camera.width, camera.height]).all(1)
    column, row = np.floor(np.where(ok[:, None], xy, 0)).astype(np.int64).T
    seen = depth[row, column].astype(np.float64)
    ok &= seen > 0
    return seen[ok], z[ok]
