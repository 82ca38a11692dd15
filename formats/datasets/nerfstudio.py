"""nerfstudio's transforms.json (also instant-ngp's and Blender's), read as a data set and written for its trainers."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import Listed, count_images, list_images, named_file, natural_key
from ..images import first_readable, image_size
from ..poses import graphics_poses
from ..textfile import number, optional_number, read_json_object, write_json
from ..trajectory import OPENCV_FROM_OPENGL
from .folder import images_outside, sequence_of
from .sequence import Camera, Dataset, distortion_names

_FILE_NAMES = ("transforms.json", "transforms_train.json")
_SUFFIXES_TRIED = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
_IMAGE_FOLDERS = ("images", "rgb", "frames", "color", "images_2", "images_4", "images_8")
_DEPTH_FOLDERS = ("depths", "depth")
_MASK_FOLDERS = ("masks", "mask")
_READ_FILES = ("file_path", "depth_file_path", "mask_path")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_INTRINSIC_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", *_DISTORTION)
_MODELS = ("OPENCV", "OPENCV_FISHEYE", "PERSPECTIVE", "PINHOLE", "RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL")
_HINTS = {"EQUIRECTANGULAR": "; for whole panoramas pass --camera equirectangular"}
_SAME_CAMERA = 0.01
_MAX_NAMED = 4
_SAME_COEFFICIENT = 0.01
"""By which a distortion coefficient may differ from the mean of all images: less than a pixel for most of the image."""


def open_nerfstudio(path: Path) -> Dataset:
    """Open the frames of a transforms.json in natural order of their names, and the images beside them for which it has
    no frame; missing images are left out and counted.

    Poses are turned from OpenGL's camera axes to x right, y down, z forward. Depth (depth_file_path) is in
    millimetres, as nerfstudio takes it, and then the poses are metric; without it they may have any scale. Masks
    (mask_path) are black where the scene is not. Raises InputError for a file that does not follow the format or names
    files outside its folder.
    """
    file = table_of(path)
    if file is None:
        raise InputError(f"no transforms.json in {path}: give the folder that holds it")
    table = read_json_object(file, allow_nan=True)
    listed = table.get("frames")
    frames = [frame for frame in listed if isinstance(frame, dict)] if isinstance(listed, list) else []
    seen: Listed = {}
    images = [_image(file, frame, seen) for frame in frames]
    kept = [(image, frame) for image, frame in zip(images, frames, strict=True) if image is not None]
    if not kept:
        raise InputError(_why_no_image(file, frames))
    frame_of = dict(kept)
    if len(frame_of) < len(kept):
        twice, count = Counter(image for image, _ in kept).most_common(1)[0]
        raise InputError(f"{file}: {count} frames are the image {twice}: put the images where their names say")
    camera, notes = _camera(table, list(frame_of.values()), file, first_readable(list(frame_of)))
    other = {
        key: {image: _other(file, frame, key, folders, seen) for image, frame in kept}
        for key, folders in (("depth_file_path", _DEPTH_FOLDERS), ("mask_path", _MASK_FOLDERS))
    }
    taken = [p for paths in other.values() for p in paths.values()]
    # What transforms_train.json does not name is meant for testing.
    others = images_outside(list(frame_of), taken) if file.name == _FILE_NAMES[0] else []
    paths = sorted([*frame_of, *others], key=lambda p: natural_key(str(p)))
    matrices = [frame_of[p].get("transform_matrix", "") if p in frame_of else None for p in paths]
    depths, masks = ([found.get(p) for p in paths] for found in other.values())
    return sequence_of(
        "nerfstudio", path, paths,
        names=_names(file, paths),
        camera=camera,
        world_from_cam=graphics_poses(matrices, file),
        metric=any(depths),
        depth_paths=tuple(depths) if any(depths) else (),
        mask_paths=tuple(masks) if any(masks) else (),
        notes=notes + _notes(file, frames, len(kept), len(others)),
    )  # fmt: skip


def _notes(file: Path, frames: list[dict[str, Any]], kept: int, others: int) -> tuple[str, ...]:
    """What of the data set is missing, and what of it has no part in the sequence."""
    unread = sorted({key for frame in frames for key in frame if key.endswith("_path")} - set(_READ_FILES))
    tables = sorted(p.name for p in file.parent.glob("transforms_*.json") if p != file)
    said = (
        (kept < len(frames), f"{len(frames) - kept} of {len(frames)} frames have no image on disk"),
        (others, f"{others} of {kept + others} images have no frame in {file.name}: they are used as well. Where the "
         f"poses of the others help, give --poses {file}"),
        (unread, f"files that the frames name under {', '.join(unread[:_MAX_NAMED])} are not read"),
        (tables, f"{', '.join(tables[:_MAX_NAMED])} beside {file.name} {'are' if tables[1:] else 'is'} not read"),
    )  # fmt: skip
    return tuple(text for holds, text in said if holds)


def table_of(path: Path) -> Path | None:
    """Return the transforms.json in a folder, or that file itself; None where there is none."""
    if path.is_file():
        return path if path.name in _FILE_NAMES else None
    return next((path / name for name in _FILE_NAMES if (path / name).is_file()), None)


def _image(file: Path, frame: dict[str, Any], seen: Listed) -> Path | None:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{file}: a frame has no file_path: expected the image's path relative to the file")
    places = _places(file, name, _IMAGE_FOLDERS)
    tried = (named_file(places, name + suffix, file, listed=seen) for suffix in _SUFFIXES_TRIED)
    return next(filter(None, tried), None)


def _places(file: Path, name: str, folders: tuple[str, ...]) -> list[Path]:
    """Where a file that a frame names may lie: beside the transforms.json, in the usual folders there, and in those
    beside its own folder for a name that leads there."""
    above = [file.parent.resolve().parent] if name.replace("\\", "/").startswith("../") else []
    return [file.parent, *(place / folder for place in (file.parent, *above) for folder in folders)]


def _why_no_image(file: Path, frames: list[dict[str, Any]]) -> str:
    why = f"{file}: none of its {len(frames)} frames has an image on disk."
    if frames:
        why += f" The first is {frames[0]['file_path'][:300]!r}; what lies outside of the folder is not read."
    if held := next((p for name in _IMAGE_FOLDERS if count_images(p := file.parent / name)), None):
        first = list_images(held)[0].name
        why += f" {held.name}/ holds {count_images(held)} images of other names, such as {first!r}."
    return f"{why} Put the images into {file.parent / _IMAGE_FOLDERS[0]}"


def _other(file: Path, frame: dict[str, Any], key: str, folders: tuple[str, ...], seen: Listed) -> Path | None:
    """The PNG that a frame names beside its image: its depth or its mask."""
    name = frame.get(key)
    if not isinstance(name, str):
        return None
    path = named_file(_places(file, name, folders), name, file, listed=seen)
    return path if path is not None and path.suffix.lower() == ".png" else None


def _names(file: Path, paths: list[Path]) -> tuple[str, ...]:
    """File names; with the folders in them where two images of different folders are called the same."""
    names = [p.name for p in paths]
    if len(set(names)) == len(names):
        return tuple(names)
    inner = (p.relative_to(file.parent) if p.is_relative_to(file.parent) else Path(*p.parts[-2:]) for p in paths)
    return tuple("_".join(p.parts) for p in inner)


def _camera(
    table: dict[str, Any], frames: list[dict[str, Any]], file: Path, image: Path
) -> tuple[Camera | None, tuple[str, ...]]:
    """The camera of all frames, None where the file states none that is of use, and notes of what is not used."""
    values, notes = _shared_intrinsics(table, frames, file)
    model = str(values.get("camera_model") or "OPENCV").upper()
    if model not in _MODELS:
        return None, (
            *notes,
            f"the camera model {model} is not supported: its intrinsics are not used{_HINTS.get(model, '')}",
        )
    actual = image_size(image)
    width, height = (int(optional_number(values, file, key) or size) for key, size in zip("wh", actual, strict=True))
    fx = _focal(values, file, "fl_x", "camera_angle_x", width)
    fy = _focal(values, file, "fl_y", "camera_angle_y", height)
    if fx is None and fy is None:
        missing = f"{file.name} states no focal length (fl_x or camera_angle_x): it is found from the images"
        return None, notes or (missing,)
    cx, cy = (optional_number(values, file, key) for key in ("cx", "cy"))
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    fisheye = model == "OPENCV_FISHEYE" or values.get("is_fisheye") is True
    names = distortion_names(fisheye)[:5]  # its k4 is not that of the rational model
    distortion = tuple(optional_number(values, file, name) or 0.0 for name in names)
    unused = [n for n in _DISTORTION if n not in names and optional_number(values, file, n)]
    if unused:
        start = "" if fisheye else ": the lens is found from the images, beginning with the stated focal length"
        notes = (*notes, f"the coefficients {', '.join(unused)} of {file.name} are not supported here{start}")
    distortion, nominal = distortion if any(distortion[4:]) else distortion[:4], bool(unused) and not fisheye
    camera = Camera(width, height, fx or fy or 0.0, fy or fx or 0.0, *center, distortion, fisheye, nominal)
    return camera.resized(*actual), notes


def _focal(values: dict[str, Any], file: Path, length: str, angle: str, side: int) -> float | None:
    """The focal length in pixels that is stated as such, or as the angle of view over a side of the image."""
    radians = optional_number(values, file, angle)
    if radians and not 0 < radians < math.pi:
        raise InputError(f"{file}: {angle} is {radians:g}, expected radians between 0 and pi")
    stated = optional_number(values, file, length)
    return side / 2 / math.tan(radians / 2) if stated is None and radians else stated


def _shared_intrinsics(
    table: dict[str, Any], frames: list[dict[str, Any]], file: Path
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The intrinsics of all frames: the mean of those that are stated for each, where they hardly differ; without any
    where they do. Phones state them anew for each image, by how far the lens has moved to focus."""
    own = [{key: frame[key] for key in _INTRINSIC_KEYS if key in frame} for frame in frames]
    values = {**table, **own[0]}
    if all(each == own[0] for each in own):
        return values, ()
    refused = (
        {k: v for k, v in table.items() if k not in _INTRINSIC_KEYS},
        ("the images have different cameras: the intrinsics in the file are not used",),
    )
    if any(each.keys() != own[0].keys() for each in own):
        return refused
    for key in own[0]:
        stated = np.array([number(each, file, key) for each in own])
        mean = float(stated.mean())
        allowed = 0.0 if key in "wh" else _SAME_COEFFICIENT if key in _DISTORTION else _SAME_CAMERA * abs(mean)
        if np.abs(stated - mean).max() > allowed:
            return refused
        values[key] = mean
    return values, ("the intrinsics of the images differ by less than 1%: their mean is used",)


def write_transforms(
    path: Path,
    camera: Camera,
    image_paths: Sequence[str],
    world_from_cam: NDArray[np.float64],
    ply_path: str | None = None,
    mask_paths: Sequence[str] = (),
    depth_paths: Sequence[str] = (),
) -> None:
    """Write a transforms.json of one pinhole camera.

    image_paths: N, relative to the file; world_from_cam (N, 4, 4), camera axes x right, y down, z forward, which
    are turned into OpenGL's; the world stays as it is. `ply_path` names a point cloud to start a splat from;
    mask_paths: N, or none, masks of the images, black where these are not to be learned from; depth_paths: N, or
    none, their depth in thousandths of the world's unit.
    Raises ValueError for shapes that do not fit, InputError when the disk refuses.
    """
    paths_of = {"depth_file_path": depth_paths, "mask_path": mask_paths}
    if world_from_cam.shape != (len(image_paths), 4, 4) or {len(p) for p in paths_of.values()} - {0, len(image_paths)}:
        raise ValueError(
            f"write_transforms: got {len(image_paths)} images, {len(mask_paths)} masks, {len(depth_paths)} depth maps, "
            f"poses {world_from_cam.shape}"
        )
    others = [{key: paths[i] for key, paths in paths_of.items() if paths} for i in range(len(image_paths))]
    names = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx}
    table: dict[str, object] = {
        "camera_model": "OPENCV", **names, "cy": camera.cy, **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "frames": [
            {"file_path": name, **other, "transform_matrix": matrix.tolist()}
            for name, other, matrix in zip(image_paths, others, world_from_cam @ OPENCV_FROM_OPENGL, strict=True)
        ],
        **({} if ply_path is None else {"ply_file_path": ply_path}),
    }  # fmt: skip
    write_json(path, table)
