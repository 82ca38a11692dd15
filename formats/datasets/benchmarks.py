"""Benchmarks of one layout each:

- Microsoft 7-Scenes: frame-XXXXXX.color, .depth.png, .pose.txt in one folder.
- TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt, each with its own clock times.
- Replica as NICE-SLAM (results/ with frameXXXXXX and depthXXXXXX, traj.txt) and Semantic-NeRF (rgb/, depth/,
  semantic_class/, traj_w_c.txt) render it.
- EuRoC MAV, left camera: mav0/cam0 with data.csv and sensor.yaml."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import frame_number, list_images
from ..images import first_readable, image_size
from ..textfile import is_number, read_table
from ..trajectory import clean_poses, poses_from_quaternions, read_matrices, read_tum
from .calibration import read_intrinsics_json, read_yaml
from .folder import (
    SAME_INSTANT_SECONDS,
    SENSOR_RATE,
    classes_of,
    files_for_images,
    nearest_index,
    poses_at,
    poses_for_images,
    read_timed_files,
    sequence_of,
)
from .sequence import Camera, Dataset, LabelClass

_CLASS_FOLDERS = ("semantic_class", "semantic_classes")

_NANOSECONDS = 1e-9

_DEPTH_PER_METRE = 5000.0
_TUM_LINE = "`seconds file`"

# The calibration of the three cameras that the benchmark's page publishes; its archives hold none.
_FREIBURG = {
    "1": (517.306408, 516.469215, 318.643040, 255.313989, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": (520.908620, 521.007327, 325.141442, 249.701764, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0)),
}
_FREIBURG_DEFAULT = (525.0, 525.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0))

_COLOR_FOCAL, _DEPTH_FOCAL = 525.0, 585.0
_COLOR_FROM_DEPTH = (-0.025, 0.0, 0.0)
"""The baseline of a Kinect, metres: depth from several views finds 25 mm sideways, 5 mm and 0.75 pixels upwards."""
_SEVEN_SCENES_NOTES = (
    "poses are KinectFusion's, good to about 1 cm",
    "depth comes from a second camera, taken to be 2.5 cm beside the colour camera",
)


def open_seven_scenes(path: Path) -> Dataset:
    """One seq-XX folder of 7-Scenes. Metric poses; frames whose pose file is missing or not finite have none.

    The set names no calibration of the colour camera: camera-intrinsics-color.txt (3x3) is used where somebody made
    one, else the focal length of 525 that relocalisation papers use; the depth camera has camera-intrinsics.txt or
    585. Both give the principal point as the middle of the image.
    """
    images = [p for p in list_images(path) if ".color." in p.name]
    numbers = [frame_number(p) for p in images]
    if not images or None in numbers:
        raise InputError(f"{path} has no frame-XXXXXX.color images: give one of the scene's seq-XX folders")
    size = image_size(first_readable(images))
    return sequence_of(
        "7scenes", path, images,
        timestamps=np.array(numbers, dtype=np.float64) / SENSOR_RATE,
        camera=_seven_scenes_camera(path / "camera-intrinsics-color.txt", size, _COLOR_FOCAL),
        world_from_cam=np.stack([pose_in(p.with_name(p.name.split(".")[0] + ".pose.txt")) for p in images]),
        depth_paths=files_for_images(images, path, "*.depth.png"),
        depth_camera=_seven_scenes_camera(path / "camera-intrinsics.txt", (640, 480), _DEPTH_FOCAL),
        color_from_depth=_COLOR_FROM_DEPTH,
        notes=_SEVEN_SCENES_NOTES,
    )  # fmt: skip


def pose_in(path: Path) -> NDArray[np.float64]:
    """Read the one (4, 4) pose of a frame from its file; NaN where there is none."""
    return read_matrices(path)[0] if path.is_file() else np.full((4, 4), np.nan)


def calibration_matrix(path: Path) -> NDArray[np.float64]:
    """Read (3, 3) of a file of 3x3 or 4x4 numbers. Raises InputError for fewer."""
    k = read_table(path, 3)
    if len(k) < 3:
        raise InputError(f"{path} has {len(k)} rows, expected a 3x3 or 4x4 calibration matrix")
    return k[:3]


def _seven_scenes_camera(path: Path, size: tuple[int, int], focal: float) -> Camera:
    width, height = size
    if not path.is_file():
        scale = width / 640
        return Camera(width, height, focal * scale, focal * scale, width / 2, height / 2, is_nominal=True)
    k = calibration_matrix(path)
    return Camera(width, height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))


def open_tum_rgbd(path: Path) -> Dataset:
    """Open a TUM RGB-D sequence: metric poses of the colour camera, depth registered to colour.

    Images, depth and poses are joined by the nearest time within 20 ms. The calibration is intrinsics.json where
    there is one, else that of the freiburg camera in the folder's name, else 525. Raises InputError for lists that
    cannot be read or name files outside the folder.
    """
    times, images = read_timed_files(path / "rgb.txt", path, float, _TUM_LINE)
    camera, notes = _tum_camera(path, first_readable(images))
    truth = path / "groundtruth.txt"
    return sequence_of(
        "tum", path, images,
        timestamps=times,
        camera=camera,
        world_from_cam=poses_at(times, *read_tum(truth)) if truth.is_file() else None,
        depth_paths=_tum_depth(path, times),
        depth_per_metre=_DEPTH_PER_METRE,
        notes=notes,
    )  # fmt: skip


def _tum_depth(path: Path, times: NDArray[np.float64]) -> tuple[Path | None, ...]:
    if not (path / "depth.txt").is_file():
        return ()
    depth_times, files = read_timed_files(path / "depth.txt", path, float, _TUM_LINE)
    index = nearest_index(depth_times, times)
    near = np.abs(depth_times[index] - times) <= SAME_INSTANT_SECONDS
    return tuple(files[i] if ok else None for i, ok in zip(index, near, strict=True))


def _tum_camera(path: Path, image: Path) -> tuple[Camera | None, tuple[str, ...]]:
    if (path / "intrinsics.json").is_file():
        return read_intrinsics_json(path / "intrinsics.json", integer_centres=True)[0], ()
    width, height = image_size(image)
    found = re.search(r"(?:freiburg|fr)([123])(?![0-9])", path.resolve().name)
    fx, fy, cx, cy, distortion = _FREIBURG[found[1]] if found else _FREIBURG_DEFAULT
    if abs(width / height - 640 / 480) > 0.02:
        return None, ("the images have not the shape of a Kinect's: the camera is taken to be unknown",)
    notes = () if found else ("the folder's name states no freiburg camera: a focal length near 525 is expected",)
    camera = Camera(640, 480, fx, fy, cx + 0.5, cy + 0.5, distortion).resized(width, height)
    return replace(camera, is_nominal=not found), notes


def open_euroc(path: Path) -> Dataset:
    """Open the left camera of a EuRoC sequence: metric poses, grey images with lens distortion, no depth.

    Poses are those of the body, moved to the camera by the extrinsics in sensor.yaml. Raises InputError where a table
    or the calibration cannot be read.
    """
    root = path / "mav0" if (path / "mav0" / "cam0").is_dir() else path
    times, images = read_timed_files(root / "cam0" / "data.csv", root / "cam0" / "data", int, "`nanoseconds,file`")
    times *= _NANOSECONDS
    camera, body_from_cam = _euroc_calibration(root / "cam0" / "sensor.yaml")
    truth, poses = root / "state_groundtruth_estimate0" / "data.csv", None
    if truth.is_file():
        table = read_table(truth, 8)  # time, position, quaternion w x y z of the body in the world
        world_from_body = poses_from_quaternions(table[:, [5, 6, 7, 4]], table[:, 1:4], str(truth))
        poses = poses_at(times, table[:, 0] * _NANOSECONDS, world_from_body @ body_from_cam)
    notes = ("the right camera, cam1/, is not read",) if (root / "cam1").is_dir() else ()
    return sequence_of("euroc", path, images, timestamps=times, camera=camera, world_from_cam=poses, notes=notes)


def _euroc_calibration(path: Path) -> tuple[Camera, NDArray[np.float64]]:
    table = read_yaml(path)
    fx, fy, cx, cy = _listed(table, path, "intrinsics", 4)
    width, height = _listed(table, path, "resolution", 2)
    distortion = _listed(table, path, "distortion_coefficients", 4)
    inner = table.get("T_BS")
    transform = np.array(_listed(inner if isinstance(inner, dict) else {}, path, "data", 16)).reshape(1, 4, 4)
    if not np.isfinite([width, height, *transform.ravel()]).all():
        raise InputError(f"{path}: a number is not finite: unpack the data set again")
    camera = Camera(int(width), int(height), fx, fy, cx + 0.5, cy + 0.5, tuple(distortion))
    return camera, clean_poses(transform, str(path))[0]


def _listed(table: dict[str, Any], path: Path, key: str, count: int) -> list[float]:
    """The numbers under a key; YAML calls 1e-5 a text."""
    found = table.get(key)
    values = [float(v) for v in found if is_number(str(v))] if isinstance(found, list) else []
    if len(values) != count:
        raise InputError(f"{path}: {key!r} is missing or not a list of {count} numbers: unpack the data set again")
    return values


def replica_folder(path: Path) -> Path | None:
    """Return the folder, this one or one in it, with results/frame*.jpg and traj.txt (NICE-SLAM), or with rgb/ and
    semantic_class/ (Semantic-NeRF, vMAP)."""
    if _is_nice_slam(path):
        return path
    rendered = (p for p in (path, path / "imap" / "00", path / "Sequence_1") if (p / "rgb").is_dir())
    return next((p for p in rendered if any((p / name).is_dir() for name in _CLASS_FOLDERS)), None)


def _is_nice_slam(path: Path) -> bool:
    return (path / "traj.txt").is_file() and any((path / "results").glob("frame*.*"))


def open_replica(path: Path) -> Dataset:
    """Open a Replica sequence; depth and poses are metric, class 0 is void.

    Without cam_params.json the renders have a horizontal field of view of 90 degrees in all layouts. Raises InputError
    where the parts do not fit together.
    """
    folder = replica_folder(path)
    if folder is None:
        raise InputError(f"{path} is no Replica sequence: expected results/ and traj.txt, or rgb/ and semantic_class/")
    return _open_nice_slam(folder) if _is_nice_slam(folder) else _open_rendered(folder)


def _open_nice_slam(path: Path) -> Dataset:
    images = [p for p in list_images(path / "results") if p.name.startswith("frame")]
    camera, scale = _replica_camera((path, path.parent), images)
    return sequence_of(
        "replica", path, images,
        camera=camera,
        world_from_cam=poses_for_images(images, read_matrices(path / "traj.txt"), path / "traj.txt"),
        depth_paths=files_for_images(images, path / "results", "depth*"),
        depth_per_metre=scale or 6553.5,
        depth_invalid=(0,),  # at 6553.5 a metre, 65535 is a true 10 m
    )  # fmt: skip


def _open_rendered(path: Path) -> Dataset:
    """traj_w_c.txt is the released trajectory; one that was estimated later goes by another traj*.txt."""
    images = list_images(path / "rgb")
    camera, scale = _replica_camera((path,), images)
    label_paths = files_for_images(images, next(path / name for name in _CLASS_FOLDERS if (path / name).is_dir()))
    truth = next((p for p in (path / "traj_w_c.txt", *sorted(path.glob("traj*.txt"))) if p.is_file()), None)
    return sequence_of(
        "replica", path, images,
        camera=camera,
        world_from_cam=None if truth is None else poses_for_images(images, read_matrices(truth), truth),
        depth_paths=files_for_images(images, path / "depth"),
        depth_per_metre=scale or 1000.0,
        label_paths=label_paths,
        classes=_replica_classes(path, label_paths),
    )  # fmt: skip


def _replica_camera(places: tuple[Path, ...], images: list[Path]) -> tuple[Camera, float | None]:
    file = next((p / "cam_params.json" for p in places if (p / "cam_params.json").is_file()), None)
    if file is not None:
        return read_intrinsics_json(file, integer_centres=True)
    width, height = image_size(first_readable(images))
    return Camera(width, height, width / 2, width / 2, width / 2, height / 2), None


def _replica_classes(path: Path, label_paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    places = (path, path.parent, path.parent.parent)
    files = [p / "info_semantic.json" for p in places]
    files += [p.parent / "semantic_info" / p.name / "info_semantic.json" for p in places]
    classes = classes_of(label_paths, next((f for f in files if f.is_file()), None))
    return tuple(c for c in classes if c.id != 0)
