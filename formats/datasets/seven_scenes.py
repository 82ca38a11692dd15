"""Microsoft 7-Scenes: frame-XXXXXX.color, .depth.png, .pose.txt in one folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_times import frame_number
from ..images import first_readable, image_size, list_images
from ..textfile import read_table
from ..trajectory import read_matrices
from .camera import Camera
from .matching import ASSUMED_RATE, files_for_images
from .sequence import Sequence

_COLOR_FOCAL, _DEPTH_FOCAL = 525.0, 585.0
_NOTES = (
    "poses are KinectFusion's, good to about 1 cm",
    "depth comes from a second camera beside the colour camera; the 2.5 cm between them are not corrected",
)


def recognises(path: Path) -> bool:
    """frame-000000.color.png and the like."""
    return any(path.glob("frame-*.color.*"))


def open_seven_scenes(path: Path) -> Sequence:
    """One seq-XX folder of 7-Scenes. Metric poses; frames whose pose file is missing or not finite have none.

    The set names no calibration of the colour camera: camera-intrinsics-color.txt (3x3) is used where somebody made
    one, else the focal length of 525 that relocalisation papers use; the depth camera has camera-intrinsics.txt or
    585. Both give the principal point as the middle of the image.
    """
    images = [p for p in list_images(path) if ".color." in p.name]
    numbers = [frame_number(p) for p in images]
    if not images or None in numbers:
        raise InputError(f"{path} has no frame-XXXXXX.color images: give one of the scene's seq-XX folders")
    size = image_size(first_readable(images))
    return Sequence(
        format="7scenes",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=np.array(numbers, dtype=np.float64) / ASSUMED_RATE,
        image_paths=tuple(images),
        camera=_camera(path / "camera-intrinsics-color.txt", size, _COLOR_FOCAL),
        world_from_cam=np.stack([_pose(p) for p in images]),
        depth_paths=files_for_images(images, path, "*.depth.png"),
        depth_camera=_camera(path / "camera-intrinsics.txt", (640, 480), _DEPTH_FOCAL),
        notes=_NOTES,
    )


def _pose(image: Path) -> NDArray[np.float64]:
    path = image.with_name(image.name.split(".")[0] + ".pose.txt")
    return read_matrices(path)[0] if path.is_file() else np.full((4, 4), np.nan)


def _camera(path: Path, size: tuple[int, int], focal: float) -> Camera:
    width, height = size
    if not path.is_file():
        scale = width / 640
        return Camera(width, height, focal * scale, focal * scale, width / 2, height / 2, is_nominal=True)
    k = read_table(path, 3)
    if k.shape != (3, 3):
        raise InputError(f"{path} has {len(k)} rows of 3 numbers, expected a 3x3 calibration matrix")
    return Camera(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
