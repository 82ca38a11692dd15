"""Camera poses by another program: COLMAP models, transforms.json, ARKit's JSON, OpenDroneMap's reconstruction.json,
Metashape's cameras.xml, tables with headings, TUM trajectories, matrices, and what apps on phones write beside their
images, all of them ARKit's in metres:

- Polycam, raw data: `keyframes/cameras/TIME.json` with the rows t_00 to t_23 of world-from-camera; where it has
  adjusted them, `keyframes/corrected_cameras/`.
- 3D Scanner App, all data: `frame_00000.json` with `cameraPoseARFrame`, sixteen numbers row by row.
- Record3D, images with `metadata.json` (or `metadata`): `poses`, for each image qx, qy, qz, qw, px, py, pz.
- Stray Scanner: `odometry.csv` with the columns timestamp, frame, x, y, z, qx, qy, qz, qw, camera axes as OpenCV's."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .colmap import read_colmap_model
from .colmap_files import find_models
from .errors import InputError
from .reading import home_expanded, note_read, parsing, reaching
from .textfile import read_json, read_json_object, read_xml
from .trajectory import OPENCV_FROM_OPENGL, clean_poses, poses_from_quaternions, read_trajectory

Array = NDArray[np.float64]
_POLYCAM = ("keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras")
_ROWS = [[f"t_{i}{j}" for j in range(4)] for i in range(3)]
Found = tuple[str, list[str], Array]
"""Of which app, the images' names, and world_from_cam (N, 4, 4)."""

_TABLES = ("transforms.json", "transforms_train.json")
_MATRIX_KEYS = (
    "transform_matrix", "cameraPoseARFrame", "transform", "camera_transform", "camera_pose", "pose", "matrix",
)  # fmt: skip
_NAME_KEYS = ("file_path", "image", "file_name", "filename", "name", "frame_name")
_TIME_KEYS = ("timestamp", "time", "t")
_HOW = (
    "give a COLMAP model's folder, a transforms.json, a JSON list of frames with a 4x4 `transform` and a name or "
    "timestamp each (ARKit), OpenDroneMap's reconstruction.json, Metashape's cameras.xml, what Polycam, 3D Scanner "
    "App, Record3D or Stray Scanner wrote, a TUM trajectory, or lines of 4x4 matrices"
)


@dataclass(frozen=True)
class PoseFile:
    """N poses: world_from_cam (N, 4, 4), camera axes x right, y down, z forward; names (N) of their images, as
    the file has them, () where it has none; times (N,) in seconds, None where it has none; `is_metric`: whether
    files of its kind always are in metres; `lost`: how many poses of the file are not finite, and here NaN or left
    out."""

    kind: str
    world_from_cam: NDArray[np.float64]
    names: tuple[str, ...] = ()
    times: NDArray[np.float64] | None = None
    is_metric: bool = False
    lost: int = 0

    def __len__(self) -> int:
        return len(self.world_from_cam)


def read_poses(path: Path) -> PoseFile:
    """Read the poses of a file or folder, whatever it is of those named above. Raises InputError for anything else."""
    with reaching(path):
        path = home_expanded(path)
        if not path.exists():
            raise InputError(f"--poses {path}: there is no such file or folder: check the spelling")
        phone = phone_poses(path) if path.is_dir() or path.suffix.lower() == ".json" else None
        if phone is not None:
            kind, names, poses = phone
            found = PoseFile(kind, poses, _unique(names, path), is_metric=True)
        else:
            found = _from_folder(path) if path.is_dir() else _OF_SUFFIX.get(path.suffix.lower(), _from_text)(path)
    known = np.isfinite(found.world_from_cam).all(axis=(1, 2))
    if not known.any():
        raise InputError(f"--poses {path} holds no pose: {_HOW}")
    lost = found.lost + int((~known).sum())
    if lost > known.sum():
        raise InputError(f"--poses {path}: {lost} of its {known.sum() + lost} poses are not finite: export it again")
    return replace(found, lost=lost)


def _from_folder(path: Path) -> PoseFile:
    if models := find_models(path):
        return _from_colmap(models[0])
    table = next((path / name for name in _TABLES if (path / name).is_file()), None)
    if table is None:
        raise InputError(f"--poses {path}: it contains neither a COLMAP model nor a transforms.json: {_HOW}")
    return _from_json(table)


def _from_colmap(folder: Path) -> PoseFile:
    model = read_colmap_model(folder)
    poses = np.asarray(np.linalg.inv(model.cam_from_world), np.float64).reshape(-1, 4, 4)
    return PoseFile("a COLMAP model", poses, model.names)


def _from_json(path: Path) -> PoseFile:
    table = read_json(path, allow_nan=True)
    if isinstance(table, list) and table and isinstance(table[0], dict) and "shots" in table[0]:
        return _from_opensfm(table, path)
    listed = table.get("frames") if isinstance(table, dict) else table
    frames = [f for f in listed if isinstance(f, dict)] if isinstance(listed, list) else []
    keys = {key for frame in frames for key in frame}
    known = _MATRIX_KEYS, _NAME_KEYS, _TIME_KEYS
    matrix, name, time = (next((k for k in wanted if k in keys), "") for wanted in known)
    frames = [f for f in frames if matrix in f]
    if not frames or not (name or time):
        raise InputError(f"--poses {path} lists no frames with a pose and a name or time: {_HOW}")
    matrices = np.stack([_matrix(frame[matrix], path, k) for k, frame in enumerate(frames)])
    # ARKit's matrices are written column by column; then what should be 0 0 0 1 is the last column.
    finite = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if finite[:, 3, :3].any() and not finite[:, :3, 3].any():
        matrices = matrices.transpose(0, 2, 1)
    poses = clean_poses(matrices, str(path)) @ OPENCV_FROM_OPENGL
    times = np.array([_number(f.get(time), path) for f in frames]) if time and not name else None
    if times is not None:
        poses[~np.isfinite(times)] = np.nan
    names = _unique((str(f.get(name, "")) for f in frames), path) if name else ()
    is_arkit = matrix != "transform_matrix" or any("depth_file_path" in f for f in frames)
    return PoseFile("ARKit's poses" if matrix != "transform_matrix" else path.name, poses, names, times, is_arkit)


def _from_opensfm(parts: list[Any], path: Path) -> PoseFile:
    """OpenDroneMap's, of its largest part: angle and axis, and translation, of camera from world."""
    from scipy.spatial.transform import Rotation

    shots = [p["shots"] for p in parts if isinstance(p, dict) and isinstance(p.get("shots"), dict)]
    largest: dict[str, Any] = max(shots, key=len, default={})
    if not largest:
        raise InputError(f"--poses {path}: it is OpenDroneMap's, and none of its images has a pose")
    cam_from_world = np.tile(np.eye(4), (len(largest), 1, 1))
    with parsing(path, "reconstruction.json of OpenDroneMap"):
        for matrix, shot in zip(cam_from_world, largest.values(), strict=True):
            matrix[:3, :3] = Rotation.from_rotvec(shot["rotation"]).as_matrix()
            matrix[:3, 3] = shot["translation"]
        poses = np.asarray(np.linalg.inv(clean_poses(cam_from_world, str(path))), np.float64)
    return PoseFile("OpenDroneMap's poses", poses, tuple(largest))


def _from_metashape(path: Path) -> PoseFile:
    """The cameras that Metashape has aligned: sixteen numbers row by row, world from camera."""
    root = read_xml(path)
    aligned = [c for c in root.iter("camera") if c.get("label") and c.findtext("transform")]
    if not aligned:
        raise InputError(f"--poses {path}: it has no <camera> with a label and a <transform>: {_HOW}")
    matrices = [_matrix((c.findtext("transform") or "").split(), path, k) for k, c in enumerate(aligned)]
    names = _unique((c.get("label") or "" for c in aligned), path)
    return PoseFile("Metashape's poses", clean_poses(np.stack(matrices), str(path)), names)


def _from_meshroom(path: Path) -> PoseFile:
    raise InputError(
        f"--poses {path} is Meshroom's own format, which is not read: run its node ExportColmap on it and give the "
        "folder that this writes"
    )


def _from_text(path: Path) -> PoseFile:
    found = read_trajectory(path)
    poses, names, times = found.world_from_cam, _unique(found.names, path), found.times
    if found.is_counted:
        return PoseFile("Stray Scanner's poses", poses, names, is_metric=True)
    if names:
        return PoseFile("a table of poses", poses, names)
    if times is None:
        return PoseFile("a file of matrices", poses)
    known = np.isfinite(poses).all(axis=(1, 2))
    return PoseFile("a TUM trajectory", poses[known], times=times[known], lost=int((~known).sum()))


_OF_SUFFIX = {".json": _from_json, ".xml": _from_metashape, ".sfm": _from_meshroom}


def _matrix(value: Any, path: Path, number: int) -> NDArray[np.float64]:
    if value is None:
        return np.full((4, 4), np.nan)
    try:
        flat = np.array(value, np.float64).ravel()
    except (TypeError, ValueError):
        flat = np.zeros(0)
    if len(flat) == 12:
        flat = np.append(flat, [0.0, 0.0, 0.0, 1.0])
    if len(flat) != 16:
        raise InputError(f"--poses {path}: frame {number + 1} has no 4x4 matrix: {_HOW}")
    return flat.reshape(4, 4)


def _number(value: Any, path: Path) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise InputError(f"--poses {path}: {str(value)[:40]!r} is not a time: give every frame its seconds as a number")
    return float(value)


def _unique(names: Iterable[str], path: Path) -> tuple[str, ...]:
    found = tuple(names)
    twice = next((n for k, n in enumerate(found) if n in found[:k]), None) if len(set(found)) < len(found) else None
    if twice is not None:
        raise InputError(f"--poses {path}: two poses are of images called {twice!r}: names must differ")
    return found


def phone_poses(path: Path) -> Found | None:
    """Return the poses that an app left in a folder, or in one file of it; None where it is none of these layouts.
    Raises InputError where it is one and damaged."""
    if path.is_file():
        return _record3d(path)
    for name in _POLYCAM:
        if files := sorted((path / name).glob("[!.]*.json")):
            note_read(path / name)
            return "Polycam's poses", [f.stem for f in files], np.stack([_polycam(f) for f in files])
    if files := sorted(path.glob("frame_*.json")):
        note_read(path)
        return "3D Scanner App's poses", [f.stem for f in files], _scanner_app(files)
    if (path / "odometry.csv").is_file():
        found = _from_text(path / "odometry.csv")
        return found.kind, list(found.names), found.world_from_cam
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
