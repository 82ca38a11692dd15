"""TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt, each with its own clock times."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..images import first_readable, image_size
from ..trajectory import read_tum
from .camera import Camera
from .intrinsics_json import read_intrinsics_json
from .matching import SAME_INSTANT_SECONDS, nearest_index, poses_at, read_timed_files
from .sequence import Sequence

_DEPTH_PER_METRE = 5000.0
_LINE = "`seconds file`"

# The calibration of the three cameras that the benchmark's page publishes; its archives hold none.
_FREIBURG = {
    "1": (517.306408, 516.469215, 318.643040, 255.313989, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": (520.908620, 521.007327, 325.141442, 249.701764, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0)),
}
_DEFAULT = (525.0, 525.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0))


def recognises(path: Path) -> bool:
    """A folder with rgb.txt and the images it lists."""
    return (path / "rgb.txt").is_file() and (path / "rgb").is_dir()


def open_tum_rgbd(path: Path) -> Sequence:
    """A TUM RGB-D sequence: metric poses of the colour camera, depth registered to colour.

    Images, depth and poses are joined by the nearest time within 20 ms. The calibration is intrinsics.json where
    there is one, else that of the freiburg camera in the folder's name, else 525. Raises InputError for lists that
    cannot be read or name files outside the folder.
    """
    times, images = read_timed_files(path / "rgb.txt", path, float, _LINE)
    camera, notes = _camera(path, first_readable(images))
    truth = path / "groundtruth.txt"
    return Sequence(
        format="tum",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=times,
        image_paths=tuple(images),
        camera=camera,
        world_from_cam=poses_at(times, *read_tum(truth)) if truth.is_file() else None,
        depth_paths=_depth_paths(path, times),
        depth_per_metre=_DEPTH_PER_METRE,
        notes=notes,
    )


def _depth_paths(path: Path, times: NDArray[np.float64]) -> tuple[Path | None, ...]:
    if not (path / "depth.txt").is_file():
        return ()
    depth_times, files = read_timed_files(path / "depth.txt", path, float, _LINE)
    index = nearest_index(depth_times, times)
    near = np.abs(depth_times[index] - times) <= SAME_INSTANT_SECONDS
    return tuple(files[i] if ok else None for i, ok in zip(index, near, strict=True))


def _camera(path: Path, image: Path) -> tuple[Camera | None, tuple[str, ...]]:
    if (path / "intrinsics.json").is_file():
        return read_intrinsics_json(path / "intrinsics.json", integer_centres=True)[0], ()
    width, height = image_size(image)
    found = re.search(r"(?:freiburg|fr)([123])(?![0-9])", path.resolve().name)
    fx, fy, cx, cy, distortion = _FREIBURG[found[1]] if found else _DEFAULT
    if abs(width / height - 640 / 480) > 0.02:
        return None, ("the images have not the shape of a Kinect's: the camera is taken to be unknown",)
    notes = () if found else ("the folder's name states no freiburg camera: a focal length near 525 is expected",)
    camera = Camera.from_integer_centres(640, 480, fx, fy, cx, cy, distortion).resized(width, height)
    return replace(camera, is_nominal=not found), notes
