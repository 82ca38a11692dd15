"""ScanNet as exported from .sens: color/, depth/, pose/, intrinsic/, label-filt/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..images import first_readable, image_size, list_images
from ..textfile import read_table
from ..trajectory import read_matrices
from .camera import Camera
from .matching import classes_found, files_for_images, times_or_frame_numbers
from .scannet_labels import find_label_table, read_nyu40_classes
from .sequence import LabelClass, Sequence

_LABEL_FOLDERS = ("label-filt", "label")
_COLOR_SIZE, _DEPTH_SIZE = (1296, 968), (640, 480)


def recognises(path: Path) -> bool:
    """color/ and pose/ with one text file a frame."""
    return (path / "color").is_dir() and (path / "pose").is_dir() and any((path / "pose").glob("*.txt"))


def open_scannet(path: Path) -> Sequence:
    """An exported ScanNet scene: metric poses, of which lost frames have none, depth of its own camera.

    Labels are joined to the NYU40 classes where scannetv2-labels.combined.tsv is in the folder or above it, else
    each raw id is a class of its own. Raises InputError where a part cannot be read.
    """
    images = list_images(path / "color")
    label_folder = next((path / name for name in _LABEL_FOLDERS if (path / name).is_dir()), path / _LABEL_FOLDERS[0])
    label_paths = files_for_images(images, label_folder)
    depth_paths = files_for_images(images, path / "depth")
    first_depth = next((p for p in depth_paths if p is not None), None)
    return Sequence(
        format="scannet",
        root=path,
        names=tuple(p.name for p in images),
        timestamps=times_or_frame_numbers(images)[0],  # the frame numbers count at the sensor's 30 a second
        image_paths=tuple(images),
        camera=_camera(path / "intrinsic" / "intrinsic_color.txt", first_readable(images), _COLOR_SIZE),
        world_from_cam=np.stack([_pose(path / "pose" / f"{p.stem}.txt") for p in images]),
        depth_paths=depth_paths,
        depth_camera=_camera(path / "intrinsic" / "intrinsic_depth.txt", first_depth, _DEPTH_SIZE),
        label_paths=label_paths,
        classes=_classes(path, label_paths),
    )


def _pose(path: Path) -> NDArray[np.float64]:
    return read_matrices(path)[0] if path.is_file() else np.full((4, 4), np.nan)


def _camera(path: Path, image: Path | None, recorded_size: tuple[int, int]) -> Camera | None:
    if image is None or not path.is_file():
        return None
    k = read_table(path, 3)
    if len(k) < 3:
        raise InputError(f"{path} has {len(k)} rows, expected a 3x3 or 4x4 calibration matrix")
    return scaled_camera(k, recorded_size, image_size(image))


def scaled_camera(k: NDArray[np.float64], recorded: tuple[int, int], actual: tuple[int, int]) -> Camera:
    """The camera with calibration matrix k (first pixel at (0, 0)) for images of the actual size.

    Images are often passed on smaller than recorded, with the calibration as it was: then the principal point is
    far from the middle, and the matrix is taken to be that of the recorded size.
    """
    fits = abs(k[0, 2] / actual[0] - 0.5) < 0.15 and abs(k[1, 2] / actual[1] - 0.5) < 0.15
    width, height = actual if fits else recorded
    values = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    return Camera.from_integer_centres(width, height, *values).resized(*actual)


def _classes(path: Path, label_paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    if not label_paths:
        return ()
    table = find_label_table(path)
    return classes_found(label_paths) if table is None else read_nyu40_classes(table)
