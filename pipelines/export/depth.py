"""The data set of `colmap.py` with a depth and a normal map for each image, as trainers supervise with."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.images import write_grey_png, write_rgb
from ..geometry.voxels import normals_in_cam
from ..render.api import median_depth
from ..run.outcome import maps_around
from ..run.target import Target
from ..types import Intrinsics
from .colmap import posed_frames, write_data_set
from .scene import ExportScene

DEPTH, NORMALS = "depth", "normals"
"""The folders."""
_UNITS = 1000.0
"""Steps of a PNG in a unit of the world, as nerfstudio expects by default: millimetres where the unit is the metre."""
_AVERAGED = 0.02
"""Share of the longer side over which normals are averaged: those of single pixels are noise (demo, in the median 21
degrees off, averaged 11)."""


def write_depth(scene: ExportScene, target: Target) -> None:
    """Write what `write_colmap` does, and depth/NAME.png for each image: the depth of the map along the optical axis in
    thousandths of the world's unit, 16 bits, as large as the frames; 0 where the map has nothing, or farther than 65
    units, and normals/NAME.png from it. transforms.json names the depths."""
    outcome, camera = scene.outcome, scene.outcome.calibration.intrinsics
    frames, near, trajectory = posed_frames(outcome), maps_around(outcome), outcome.trajectory
    names = [f"{DEPTH}/{frame.name}.png" for frame in frames]
    folder = target.path(DEPTH)
    target.path(NORMALS)
    for frame, name in zip(frames, names, strict=True):
        part, pose = near(frame.id), trajectory.cam_from_world[outcome.frame_row(frame.id)]
        cam_from_world = torch.as_tensor(pose, dtype=torch.float64, device=part.means.device)
        depth = median_depth(part, cam_from_world, camera).cpu().numpy()
        steps = np.round(_UNITS * depth)
        write_grey_png(folder.parent / name, np.where(steps < 2**16, steps, 0).astype(np.uint16))
        write_rgb(folder.parent / NORMALS / f"{frame.name}.png", normal_map(depth, camera))
    write_data_set(scene, target, names)


def normal_map(depth: NDArray[np.float32], intrinsics: Intrinsics) -> NDArray[np.uint8]:
    """Return (H, W, 3): 127.5 (n + 1) of the unit normals n that face the camera, in its axes (x right, y down, z
    forward); black where none is known."""
    width = 2 * round(_AVERAGED * max(depth.shape) / 2) + 1
    normals = normals_in_cam(depth, intrinsics)
    mean = cv2.boxFilter(normals, -1, (width, width), normalize=False)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    known = normals.any(-1, keepdims=True) & (length > 0)
    return np.where(known, np.round(127.5 * (mean / np.maximum(length, 1e-12) + 1)), 0).astype(np.uint8)
