"""nerfstudio's transforms.json (also instant-ngp's and Blender's)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets.camera import Camera
from msgs_slam.formats.datasets.matching import times_or_frame_numbers
from msgs_slam.formats.datasets.sequence import Sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import image_size, natural_key
from msgs_slam.formats.jsonfile import number, optional_number, read_json_object
from msgs_slam.formats.safe_path import inside
from msgs_slam.formats.trajectory import clean_poses

_FILE_NAMES = ("transforms.json", "transforms_train.json")
_SUFFIXES_TRIED = ("", ".png", ".jpg", ".jpeg")
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_INTRINSIC_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "k1", "k2", "k3", "k4", "p1", "p2")


def recognises(path: Path) -> bool:
    """A folder with transforms.json, or that file itself."""
    return _file(path) is not None


def open_nerfstudio(path: Path) -> Sequence:
    """The frames of a transforms.json in natural order of their names; missing images are left out and counted.

    Poses are turned from OpenGL's camera axes to x right, y down, z forward. Depth (depth_file_path) is in
    millimetres, as nerfstudio takes it, and then the poses are metric; without it they may have any scale. Raises
    InputError for a file that does not follow the format or names files outside its folder.
    """
    file = _file(path)
    if file is None:
        raise InputError(f"no transforms.json in {path}: give the folder that holds it")
    table = read_json_object(file)
    listed = table.get("frames")
    frames = [frame for frame in listed if isinstance(frame, dict)] if isinstance(listed, list) else []
    images = {id(frame): _image(file, frame) for frame in frames}
    kept = [frame for frame in frames if images[id(frame)] is not None]
    if not kept:
        raise InputError(f"{file}: none of its {len(frames)} frames has an image on disk: unpack it completely")
    kept.sort(key=lambda frame: natural_key(str(images[id(frame)])))
    paths = [p for p in (images[id(frame)] for frame in kept) if p is not None]
    poses = np.stack([_matrix(frame, file) for frame in kept]) @ _OPENCV_FROM_OPENGL
    depth_paths = tuple(_depth(file, frame) for frame in kept)
    camera, notes = _camera(table, kept, file, paths[0])
    missing = len(frames) - len(kept)
    times, timed = times_or_frame_numbers(paths)
    return Sequence(
        format="nerfstudio",
        root=path,
        names=_names(file, paths),
        timestamps=times,
        image_paths=tuple(paths),
        timed=timed,
        camera=camera,
        world_from_cam=clean_poses(poses, str(file)),
        metric=any(depth_paths),
        depth_paths=depth_paths if any(depth_paths) else (),
        notes=notes + ((f"{missing} of {len(frames)} frames have no image on disk",) if missing else ()),
    )


def _file(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name in _FILE_NAMES else None
    return next((path / name for name in _FILE_NAMES if (path / name).is_file()), None)


def _image(file: Path, frame: dict[str, Any]) -> Path | None:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{file}: a frame has no file_path: expected the image's path relative to the file")
    tried = (inside(file.parent, name + suffix, file) for suffix in _SUFFIXES_TRIED)
    return next((p for p in tried if p.is_file()), None)


def _depth(file: Path, frame: dict[str, Any]) -> Path | None:
    name = frame.get("depth_file_path")
    if not isinstance(name, str):
        return None
    path = inside(file.parent, name, file)
    return path if path.is_file() and path.suffix.lower() == ".png" else None


def _names(file: Path, paths: list[Path]) -> tuple[str, ...]:
    """File names; with the folders in them where two images of different folders are called the same."""
    names = [p.name for p in paths]
    if len(set(names)) == len(names):
        return tuple(names)
    return tuple("_".join(p.relative_to(file.parent).parts) for p in paths)


def _matrix(frame: dict[str, Any], file: Path) -> NDArray[np.float64]:
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        raise InputError(f"{file}: frame {frame.get('file_path')!r} has no 4x4 transform_matrix: add it")
    return matrix


def _camera(
    table: dict[str, Any], frames: list[dict[str, Any]], file: Path, image: Path
) -> tuple[Camera | None, tuple[str, ...]]:
    own = [{k: frame[k] for k in _INTRINSIC_KEYS if k in frame} for frame in frames]
    if any(values != own[0] for values in own):
        return None, ("the images have different cameras: the intrinsics in the file are not used",)
    values = {**table, **own[0]}
    actual = image_size(image)
    width, height = (int(optional_number(values, file, key) or size) for key, size in zip("wh", actual, strict=True))
    angle = optional_number(values, file, "camera_angle_x")
    if angle and not 0 < angle < math.pi:
        raise InputError(f"{file}: camera_angle_x is {angle:g}, expected radians between 0 and pi")
    fx = width / 2 / math.tan(angle / 2) if angle and "fl_x" not in values else number(values, file, "fl_x")
    fy = optional_number(values, file, "fl_y") or fx
    cx, cy = (optional_number(values, file, key) for key in ("cx", "cy"))
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    fisheye = values.get("camera_model") == "OPENCV_FISHEYE"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    distortion = tuple(optional_number(values, file, name) or 0.0 for name in names)
    return Camera(width, height, fx, fy, *center, distortion, fisheye).resized(*actual), ()
