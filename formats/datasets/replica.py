"""Replica in the three layouts in which the field passes it on."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import list_images
from ..images import first_readable, image_size
from ..trajectory import read_matrices
from .calibration import read_intrinsics_json
from .matching import classes_found, files_for_images, poses_for_images, times_or_frame_numbers
from .sequence import Camera, LabelClass, Sequence, read_classes_json

_CLASS_FOLDERS = ("semantic_class", "semantic_classes")


def recognises(path: Path) -> bool:
    """Recognise results/frame*.jpg with traj.txt (NICE-SLAM), or rgb/ with semantic_class/ (Semantic-NeRF, vMAP)."""
    return _is_nice_slam(path) or any(_is_rendered(p) for p in _candidates(path))


def open_replica(path: Path) -> Sequence:
    """Open a Replica sequence; depth and poses are metric, class 0 is void.

    Without cam_params.json the renders have a horizontal field of view of 90 degrees in all layouts. Raises InputError
    where the parts do not fit together.
    """
    if _is_nice_slam(path):
        return _open_nice_slam(path)
    for candidate in _candidates(path):
        if _is_rendered(candidate):
            return _open_rendered(candidate)
    raise InputError(f"{path} is no Replica sequence: expected results/ and traj.txt, or rgb/ and semantic_class/")


def _candidates(path: Path) -> tuple[Path, ...]:
    return path, path / "imap" / "00", path / "Sequence_1"


def _is_nice_slam(path: Path) -> bool:
    return (path / "traj.txt").is_file() and any((path / "results").glob("frame*.*"))


def _is_rendered(path: Path) -> bool:
    return (path / "rgb").is_dir() and any((path / name).is_dir() for name in _CLASS_FOLDERS)


def _open_nice_slam(path: Path) -> Sequence:
    images = [p for p in list_images(path / "results") if p.name.startswith("frame")]
    parameters = next((p / "cam_params.json" for p in (path, path.parent) if (p / "cam_params.json").is_file()), None)
    camera, scale = _wide_camera(first_readable(images)), 6553.5
    times, timed = times_or_frame_numbers(images)
    if parameters is not None:
        camera, given = read_intrinsics_json(parameters, integer_centres=True)
        scale = given or scale
    return Sequence(
        format="replica",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=times,
        image_paths=tuple(images),
        timed=timed,
        camera=camera,
        world_from_cam=poses_for_images(images, read_matrices(path / "traj.txt"), path / "traj.txt"),
        depth_paths=files_for_images(images, path / "results", "depth*"),
        depth_per_metre=scale,
        depth_invalid=(0,),  # at 6553.5 a metre, 65535 is a true 10 m
    )


def _open_rendered(path: Path) -> Sequence:
    images = list_images(path / "rgb")
    camera, scale = _wide_camera(first_readable(images)), None
    times, timed = times_or_frame_numbers(images)
    if (path / "cam_params.json").is_file():
        camera, scale = read_intrinsics_json(path / "cam_params.json", integer_centres=True)
    label_folder = next(path / name for name in _CLASS_FOLDERS if (path / name).is_dir())
    label_paths = files_for_images(images, label_folder)
    return Sequence(
        format="replica",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=times,
        image_paths=tuple(images),
        timed=timed,
        camera=camera,
        world_from_cam=_rendered_poses(path, images),
        depth_paths=files_for_images(images, path / "depth"),
        depth_per_metre=scale or 1000.0,
        label_paths=label_paths,
        classes=_classes(path, label_paths),
    )


def _rendered_poses(path: Path, images: list[Path]) -> NDArray[np.float64] | None:
    """traj_w_c.txt is the released one; a trajectory estimated later goes by another traj*.txt."""
    files = [path / "traj_w_c.txt", *sorted(path.glob("traj*.txt"))]
    file = next((p for p in files if p.is_file()), None)
    return None if file is None else poses_for_images(images, read_matrices(file), file)


def _wide_camera(image: Path) -> Camera:
    width, height = image_size(image)
    return Camera(width, height, width / 2, width / 2, width / 2, height / 2)


def _classes(path: Path, label_paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    if not label_paths:
        return ()
    places = (path, path.parent, path.parent.parent)
    files = [p / "info_semantic.json" for p in places]
    files += [p.parent / "semantic_info" / p.name / "info_semantic.json" for p in places]
    file = next((f for f in files if f.is_file()), None)
    classes = classes_found(label_paths) if file is None else read_classes_json(file)
    return tuple(c for c in classes if c.id != 0)
