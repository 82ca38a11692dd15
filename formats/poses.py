"""Camera poses by another program: COLMAP models, transforms.json, ARKit's JSON, OpenDroneMap's reconstruction.json,
Metashape's cameras.xml, tables with headings, TUM trajectories, matrices, and what apps on phones write beside their
images, all of them ARKit's in metres:

- Polycam, raw data: `keyframes/cameras/TIME.json` with the rows t_00 to t_23 of world-from-camera; where it has
  adjusted them, `keyframes/corrected_cameras/`.
- 3D Scanner App, all data: `frame_00000.json` with `cameraPoseARFrame`, sixteen numbers row by row.
- Record3D, images with `metadata.json` (or `metadata`): `poses`, for each image qx, qy, qz, qw, px, py, pz.
- Stray Scanner: `odometry.csv` with the columns timestamp, frame, x, y, z, qx, qy, qz, qw, camera axes as OpenCV's."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .colmap import find_models, read_colmap_model
from .errors import InputError
from .reading import home_expanded, note_read, parsing, reaching
from .textfile import read_json, read_json_object, read_xml
from .trajectory import OPENCV_FROM_OPENGL, PoseFile, clean_poses, poses_from_quaternions, read_trajectory

Array = NDArray[np.float64]
_POLYCAM = ("keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras")

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


def read_poses(path: Path) -> PoseFile:
    """Read the poses of a file or folder, whatever it is of those named above. Raises InputError for anything else."""
    with reaching(path):
        path = home_expanded(path)
        if not path.exists():
            raise InputError(f"--poses {path}: there is no such file or folder: check the spelling")
        found = _of_phone(path) if path.is_dir() or path.suffix.lower() == ".json" else None
        if found is None:
            found = _from_folder(path) if path.is_dir() else _OF_SUFFIX.get(path.suffix.lower(), read_trajectory)(path)
    twice, count = Counter(found.names).most_common(1)[0] if found.names else ("", 1)
    if count > 1:
        raise InputError(f"--poses {path}: two poses are of images called {twice!r}: names must differ")
    known = np.isfinite(found.world_from_cam).all(axis=(1, 2))
    if not known.any():
        raise InputError(f"--poses {path} holds no pose: {_HOW}")
    lost = int((~known).sum())
    if lost > known.sum():
        raise InputError(f"--poses {path}: {lost} of its {len(found)} poses are not finite: export it again")
    return replace(found, lost=lost)


def _from_folder(path: Path) -> PoseFile:
    if models := find_models(path):
        model = read_colmap_model(models[0])
        poses = np.asarray(np.linalg.inv(model.cam_from_world), np.float64).reshape(-1, 4, 4)
        return PoseFile("a COLMAP model", poses, model.names)
    table = next((path / name for name in _TABLES if (path / name).is_file()), None)
    if table is None:
        raise InputError(f"--poses {path}: it contains neither a COLMAP model nor a transforms.json: {_HOW}")
    return _from_json(table)


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
    poses = graphics_poses([frame[matrix] for frame in frames], path)
    times = None
    if time and not name:
        stated = [frame.get(time) for frame in frames]
        if wrong := [t for t in stated if not isinstance(t, int | float) or isinstance(t, bool)]:
            raise InputError(f"--poses {path}: {str(wrong[0])[:40]!r} is not a time: give every frame its seconds")
        times = np.array(stated, np.float64)
        poses[~np.isfinite(times)] = np.nan
    names = tuple(str(f.get(name, "")) for f in frames) if name else ()
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
    names = tuple(c.get("label") or "" for c in aligned)
    return PoseFile("Metashape's poses", clean_poses(np.stack(matrices), str(path)), names)


def _from_meshroom(path: Path) -> PoseFile:
    raise InputError(f"--poses {path} is Meshroom's own format: give the folder that its node ExportColmap writes")


_OF_SUFFIX = {".json": _from_json, ".xml": _from_metashape, ".sfm": _from_meshroom}


def graphics_poses(values: Sequence[Any], path: Path) -> Array:
    """Return (N, 4, 4) world_from_cam, NaN where lost, of matrices of 16 or 12 numbers each whose cameras have y up and
    z backward, row by row or, as ARKit writes them, column by column; None is a lost one. Raises InputError for what is
    no rigid transform."""
    matrices = np.stack([_matrix(value, path, k) for k, value in enumerate(values)])
    # By columns, what should be 0 0 0 1 is the last column.
    finite = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if finite[:, 3, :3].any() and not finite[:, :3, 3].any():
        matrices = matrices.transpose(0, 2, 1)
    return np.asarray(clean_poses(matrices, str(path)) @ OPENCV_FROM_OPENGL)


def _matrix(value: Any, path: Path, number: int) -> Array:
    try:
        flat = np.full(16, np.nan) if value is None else np.array(value, np.float64).ravel()
    except (TypeError, ValueError):
        flat = np.zeros(0)
    if len(flat) == 12:
        flat = np.append(flat, [0.0, 0.0, 0.0, 1.0])
    if len(flat) != 16:
        raise InputError(f"{path}: frame {number + 1} has no 4x4 matrix of sixteen numbers: {_HOW}")
    return flat.reshape(4, 4)


def _of_phone(path: Path) -> PoseFile | None:
    """The poses that an app left in a folder, or in one file of it; None where it is none of these layouts."""
    if path.is_file():
        return _record3d(path)
    for name in _POLYCAM:
        if files := sorted((path / name).glob("[!.]*.json")):
            note_read(path / name)
            tables = (read_json_object(f, allow_nan=True) for f in files)
            rows = [[table.get(f"t_{i}{j}", "") for i in range(3) for j in range(4)] for table in tables]
            return _of_app("Polycam's poses", files, graphics_poses(rows, path / name))
    if files := sorted(path.glob("frame_*.json")):
        note_read(path)
        values = [read_json_object(f, allow_nan=True).get("cameraPoseARFrame", "") for f in files]
        return _of_app("3D Scanner App's poses", files, graphics_poses(values, path))
    if (path / "odometry.csv").is_file():
        return read_trajectory(path / "odometry.csv")
    table = next((path / n for n in ("metadata.json", "metadata") if (path / n).is_file()), None)
    return None if table is None else _record3d(table)


def _of_app(kind: str, files: list[Path], poses: Array) -> PoseFile:
    return PoseFile(kind, poses, tuple(file.stem for file in files), is_metric=True)


def _record3d(path: Path) -> PoseFile | None:
    table = read_json(path, allow_nan=True)
    rows = table.get("poses") if isinstance(table, dict) else None
    if not isinstance(rows, list) or not rows:
        return None
    if not all(isinstance(r, list) and len(r) == 7 and all(isinstance(v, int | float) for v in r) for r in rows):
        raise InputError(f"{path}: a pose is not seven numbers (quaternion, position): export it again")
    values = np.array(rows, np.float64)
    poses = poses_from_quaternions(values[:, :4], values[:, 4:], str(path)) @ OPENCV_FROM_OPENGL
    return PoseFile("Record3D's poses", poses, tuple(map(str, range(len(rows)))), is_metric=True)
