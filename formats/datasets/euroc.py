"""EuRoC MAV, left camera: mav0/cam0 with data.csv and sensor.yaml."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..textfile import read_table, read_text
from ..trajectory import clean_poses, poses_from_quaternions
from .camera import Camera
from .matching import poses_at, read_timed_files
from .sequence import Sequence

_NANOSECONDS = 1e-9


def recognises(path: Path) -> bool:
    """A folder with mav0/cam0/data.csv, or mav0 itself."""
    return any((root / "cam0" / "data.csv").is_file() for root in (path / "mav0", path))


def open_euroc(path: Path) -> Sequence:
    """The left camera of a EuRoC sequence: metric poses, grey images with lens distortion, no depth.

    Poses are those of the body, moved to the camera by the extrinsics in sensor.yaml. Raises InputError where a table
    or the calibration cannot be read.
    """
    root = path / "mav0" if (path / "mav0" / "cam0").is_dir() else path
    times, images = _images(root / "cam0")
    camera, body_from_cam = _calibration(root / "cam0" / "sensor.yaml")
    return Sequence(
        format="euroc",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=times,
        image_paths=tuple(images),
        camera=camera,
        world_from_cam=_poses(root / "state_groundtruth_estimate0" / "data.csv", times, body_from_cam),
    )


def _images(cam: Path) -> tuple[NDArray[np.float64], list[Path]]:
    times, files = read_timed_files(cam / "data.csv", cam / "data", int, "`nanoseconds,file`")
    return times * _NANOSECONDS, files


def _poses(path: Path, times: NDArray[np.float64], body_from_cam: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Rows of time, position, quaternion w x y z of the body in the world."""
    if not path.is_file():
        return None
    table = read_table(path, 8)
    world_from_body = poses_from_quaternions(table[:, [5, 6, 7, 4]], table[:, 1:4], str(path))
    return poses_at(times, table[:, 0] * _NANOSECONDS, world_from_body @ body_from_cam)


def _calibration(path: Path) -> tuple[Camera, NDArray[np.float64]]:
    text = read_text(path)
    fx, fy, cx, cy = _numbers(text, path, "intrinsics", 4)
    width, height = _numbers(text, path, "resolution", 2)
    distortion = _numbers(text, path, "distortion_coefficients", 4)
    transform = np.array(_numbers(text, path, "data", 16)).reshape(1, 4, 4)
    if not np.isfinite([width, height, *transform.ravel()]).all():
        raise InputError(f"{path}: a number is not finite: unpack the data set again")
    camera = Camera.from_integer_centres(int(width), int(height), fx, fy, cx, cy, tuple(distortion))
    return camera, clean_poses(transform, str(path))[0]


def _numbers(text: str, path: Path, key: str, count: int) -> list[float]:
    """The list under a key of the YAML file, which may go over several lines."""
    found = re.search(rf"^\s*{key}\s*:\s*\[([^\]]*)\]", text, flags=re.MULTILINE)
    try:
        values = [float(part) for part in found[1].split(",")] if found else []
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{path}: {key!r} is missing or not a list of {count} numbers: unpack the data set again")
    return values
