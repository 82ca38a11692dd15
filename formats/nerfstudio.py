"""nerfstudio's transforms.json, written for its trainers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import write_text
from .trajectory import OPENCV_FROM_OPENGL


def write_transforms(
    path: Path,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    image_paths: tuple[str, ...] | list[str],
    world_from_cam: NDArray[np.float64],
    ply_path: str | None = None,
) -> None:
    """Write a transforms.json of one pinhole camera.

    image_paths: N, relative to the file; world_from_cam (N, 4, 4), camera axes x right, y down, z forward, which
    are turned into OpenGL's; the world stays as it is. `ply_path` names a point cloud to start a splat from.
    Raises ValueError for shapes that do not fit, InputError when the disk refuses.
    """
    if world_from_cam.shape != (len(image_paths), 4, 4):
        raise ValueError(f"write_transforms: got {len(image_paths)} images and poses {world_from_cam.shape}")
    matrices = world_from_cam @ OPENCV_FROM_OPENGL
    table: dict[str, object] = {
        "camera_model": "OPENCV",
        "w": width,
        "h": height,
        "fl_x": float(fx),
        "fl_y": float(fy),
        "cx": float(cx),
        "cy": float(cy),
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "frames": [
            {"file_path": name, "transform_matrix": matrix.tolist()}
            for name, matrix in zip(image_paths, matrices, strict=True)
        ],
    }
    if ply_path is not None:
        table["ply_file_path"] = ply_path
    write_text(path, json.dumps(table, indent=1, allow_nan=False) + "\n")
