"""Plain folders: images, with companion files under the usual names."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import count_images, list_images, read_image_times
from ..names import match_names
from ..trajectory import read_trajectory
from .calibration import read_intrinsics_json
from .matching import classes_found, files_for_images, poses_at, poses_for_images, sequence_of
from .sequence import Camera, Dataset, LabelClass, known_classes

_IMAGE_FOLDERS = ("rgb", "images", "color", "frames")
_DEPTH_FOLDERS = ("depth", "depths")
_LABEL_FOLDERS = ("labels", "label", "semantic")
_POSE_FILES = ("traj.txt", "trajectory.txt", "poses.txt", "groundtruth.txt")
_INTRINSICS_FILES = ("intrinsics.json", "cam_params.json", "camera.json")


def is_plain_folder(path: Path) -> bool:
    """Recognise a folder of images, or one with a folder rgb/, images/, color/ or frames/."""
    return image_folder(path) is not None


def open_folder(path: Path) -> Dataset:
    """Open a plain folder: only the images must be there.

    Beside or above them may be depth/ (16 bit PNG, millimetres unless depth_scale in the intrinsics says otherwise),
    labels/ (8 or 16 bit PNG of class ids) with classes.json, intrinsics.json (fx, fy, cx, cy, width, height,
    distortion, depth_scale, pixel_centre), timestamps.txt, and traj.txt: world-from-camera, a 4x4 matrix or a TUM line
    for each image or each frame number. Raises InputError where one of them contradicts the images.
    """
    counts = _image_counts(path)
    folder = _fullest(counts)
    if folder is None:
        raise InputError(f"no images in {path}: give the folder that holds the images, or one above rgb/ or images/")
    images = list_images(folder)
    root = path if folder != path else _root_of(folder)
    times = read_image_times(images)
    poses, left_out = _poses(images, times, root)
    camera, depth_scale = _camera(root)
    depth_paths = _first(images, root, _DEPTH_FOLDERS)
    label_paths = _first(images, root, _LABEL_FOLDERS)
    return sequence_of(
        "folder", root, images,
        timestamps=times,
        camera=camera,
        world_from_cam=poses,
        depth_paths=depth_paths,
        depth_per_metre=depth_scale or 1000.0,
        label_paths=label_paths,
        classes=_classes(root, label_paths),
        notes=_unused_images(counts, folder) + left_out,
    )  # fmt: skip


def image_folder(path: Path) -> Path | None:
    """Return the folder that holds most images: this one, or the rgb/, images/, color/ or frames/ in it. None without
    any.

    A picture or two beside images/ are thumbnails or plots; the other way round images/ is something else's.
    """
    return _fullest(_image_counts(path))


def _fullest(counts: dict[Path, int]) -> Path | None:
    return max(counts, key=counts.__getitem__) if any(counts.values()) else None


def _image_counts(path: Path) -> dict[Path, int]:
    return {folder: count_images(folder) for folder in (path, *(path / name for name in _IMAGE_FOLDERS))}


def _unused_images(counts: dict[Path, int], used: Path) -> tuple[str, ...]:
    others = [f"{count} in {folder.name}/" for folder, count in counts.items() if count and folder != used]
    if not others:
        return ()
    return (f"the {counts[used]} images in {used.name}/ are used, not the {' and '.join(others)}",)


def _root_of(images: Path) -> Path:
    """Where to look for what belongs to a folder of images: above it, when it is the rgb/ of a larger folder."""
    siblings = (*_DEPTH_FOLDERS, *_LABEL_FOLDERS, *_POSE_FILES, *_INTRINSICS_FILES)
    belongs = images.name in _IMAGE_FOLDERS and any((images.parent / name).exists() for name in siblings)
    return images.parent if belongs else images


def _camera(root: Path) -> tuple[Camera | None, float | None]:
    for name in _INTRINSICS_FILES:
        if (root / name).is_file():
            return read_intrinsics_json(root / name, integer_centres=False)
    return None, None


def _first(images: list[Path], root: Path, folders: tuple[str, ...]) -> tuple[Path | None, ...]:
    existing = [root / name for name in folders if (root / name).is_dir() and root / name != images[0].parent]
    return files_for_images(images, existing[0]) if existing else ()


def _poses(
    images: list[Path], times: NDArray[np.float64] | None, root: Path
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """(N, 4, 4) poses, None without any, and a note where there are some that cannot be assigned."""
    path = next((root / name for name in _POSE_FILES if (root / name).is_file()), None)
    if path is None:
        return None, ()
    found = read_trajectory(path)
    if found.names:
        rows = match_names([str(image) for image in images], found.names)
        return np.stack([np.full((4, 4), np.nan) if k is None else found.world_from_cam[k] for k in rows]), ()
    if found.times is None:
        return poses_for_images(images, found.world_from_cam, path), ()
    if times is not None:
        return poses_at(times, found.times, found.world_from_cam), ()
    if len(found.times) == len(images):
        return found.world_from_cam, ()
    why = f"the {len(found.times)} poses of {path.name} belong to times, and the {len(images)} images state none"
    return None, (f"{why}: the poses are not used; timestamps.txt with a line for each image would tell",)


def _classes(root: Path, label_paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    if not label_paths:
        return ()
    path = root / "classes.json"
    return known_classes(path) if path.is_file() else classes_found(label_paths)
