"""Camera poses as apps on phones write them beside their images: Polycam, 3D Scanner App, Record3D, Stray Scanner.

All are ARKit's, in metres. What each writes, by its published layout:

- Polycam, raw data: `keyframes/cameras/TIME.json` with the rows t_00 to t_23 of world-from-camera; where it has
  adjusted them, `keyframes/corrected_cameras/`.
- 3D Scanner App, all data: `frame_00000.json` with `cameraPoseARFrame`, sixteen numbers row by row.
- Record3D, images with `metadata.json` (or `metadata`): `poses`, for each image qx, qy, qz, qw, px, py, pz.
- Stray Scanner: `odometry.csv` with the columns timestamp, frame, x, y, z, qx, qy, qz, qw, camera axes as OpenCV's.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .jsonfile import read_json, read_json_object
from .textfile import read_text
from .trajectory import OPENCV_FROM_OPENGL, clean_poses, poses_from_quaternions

Array = NDArray[np.float64]
_POLYCAM = ("keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras")
_ROWS = [[f"t_{i}{j}" for j in range(4)] for i in range(3)]
_ODOMETRY = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")
Found = tuple[str, list[str], Array]
"""Of which app, the images' names without suffix, and world_from_cam (N, 4, 4)."""


def phone_poses(path: Path) -> Found | None:
    """The poses that an app left in a folder, or in one file of it; None where it is none of these layouts. Raises
    InputError where it is one and damaged."""
    if path.is_file():
        return _stray(path) if path.suffix.lower() == ".csv" else _record3d(path)
    for name in _POLYCAM:
        if files := sorted((path / name).glob("[!.]*.json")):
            return "Polycam's poses", [f.stem for f in files], np.stack([_polycam(f) for f in files])
    if files := sorted(path.glob("frame_*.json")):
        return "3D Scanner App's poses", [f.stem for f in files], _scanner_app(files)
    if (path / "odometry.csv").is_file():
        return _stray(path / "odometry.csv")
    table = next((path / n for n in ("metadata.json", "metadata") if (path / n).is_file()), None)
    return None if table is None else _record3d(table)


def _polycam(path: Path) -> Array:
    table = read_json_object(path, allow_nan=True)
    matrix = np.eye(4)
    try:
        matrix[:3] = [[float(table[key]) for key in row] for row in _ROWS]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} has no pose of twelve numbers, t_00 to t_23 ({error}): export it again") from error
    return np.asarray(clean_poses(matrix[None], str(path))[0] @ OPENCV_FROM_OPENGL)


def _scanner_app(files: list[Path]) -> Array:
    matrices = []
    for path in files:
        flat = read_json_object(path, allow_nan=True).get("cameraPoseARFrame")
        if not isinstance(flat, list) or len(flat) != 16 or not all(isinstance(v, int | float) for v in flat):
            raise InputError(f"{path} has no cameraPoseARFrame of sixteen numbers: export all data again")
        matrices.append(np.array(flat, np.float64).reshape(4, 4))
    return np.asarray(clean_poses(np.stack(matrices), str(files[0].parent)) @ OPENCV_FROM_OPENGL)


def _record3d(path: Path) -> Found | None:
    table = read_json(path, allow_nan=True)
    rows = table.get("poses") if isinstance(table, dict) else None
    if not isinstance(rows, list) or not rows:
        return None
    if not all(isinstance(r, list) and len(r) == 7 and all(isinstance(v, int | float) for v in r) for r in rows):
        raise InputError(f"{path}: a pose is not seven numbers (quaternion, position): export it again")
    values = np.array(rows, np.float64)
    poses = poses_from_quaternions(values[:, :4], values[:, 4:], str(path)) @ OPENCV_FROM_OPENGL
    return "Record3D's poses", [str(i) for i in range(len(rows))], poses


def _stray(path: Path) -> Found:
    rows = csv.DictReader(io.StringIO(read_text(path)), skipinitialspace=True)
    names = [name.strip() for name in rows.fieldnames or ()]
    if missing := [n for n in _ODOMETRY if n not in names]:
        raise InputError(f"{path}: no column {missing[0]}: Stray Scanner's odometry.csv has {', '.join(_ODOMETRY)}")
    try:
        values = np.array([[float(row[n]) for n in _ODOMETRY] for row in rows]).reshape(-1, len(_ODOMETRY))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: a row has something else than numbers ({error}): export it again") from error
    poses = poses_from_quaternions(values[:, 4:], values[:, 1:4], str(path))
    return "Stray Scanner's poses", [f"{int(frame):06d}" for frame in values[:, 0]], poses
