"""The data set of `colmap.py` with a depth map for each image, as nerfstudio supervises with."""

from __future__ import annotations

import numpy as np
import torch

from ...formats.images import write_grey_png
from ..render.api import median_depth
from ..run.outcome import maps_around
from ..run.target import Target
from .colmap import posed_frames, write_data_set
from .scene import ExportScene

DEPTH = "depth"
"""The folder."""
_UNITS = 1000.0
"""Steps of a PNG in a unit of the world, as nerfstudio expects by default: millimetres where the unit is the metre."""


def write_depth(scene: ExportScene, target: Target) -> None:
    """Write what `write_colmap` does, and depth/NAME.png for each image: the depth of the map along the optical axis in
    thousandths of the world's unit, 16 bits, as large as the frames; 0 where the map has nothing, or farther than 65
    units. transforms.json names them."""
    outcome = scene.outcome
    frames, near, trajectory = posed_frames(outcome), maps_around(outcome), outcome.trajectory
    names = [f"{DEPTH}/{frame.name}.png" for frame in frames]
    folder = target.path(DEPTH)
    for frame, name in zip(frames, names, strict=True):
        part, pose = near(frame.id), trajectory.cam_from_world[outcome.frame_row(frame.id)]
        cam_from_world = torch.as_tensor(pose, dtype=torch.float64, device=part.means.device)
        depth = median_depth(part, cam_from_world, outcome.calibration.intrinsics).cpu().numpy()
        steps = np.round(_UNITS * depth)
        write_grey_png(folder.parent / name, np.where(steps < 2**16, steps, 0).astype(np.uint16))
    write_data_set(scene, target, names)
