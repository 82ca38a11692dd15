"""COLMAP models: where a project has them, whether they are whole, read and written by pycolmap."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path, explained, temporary_folder
from .errors import InputError
from .reading import noting_files, opened, parsing, read_bytes, require_file
from .trajectory import FARTHEST, nearest_rotation, poses_from_quaternions

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

_PARTS = ("cameras", "images", "points3D")
_MODEL_PLACES = ("sparse", "colmap/sparse", ".")
"""Where a project keeps its models, each in a folder of its own or one without."""
_CAMERA_ID = 1

# Parameters of each of COLMAP's camera models, in the order of the models' ids (SIMPLE_PINHOLE first).
_PARAMETER_COUNTS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))
_CAMERA_HEAD_BYTES = 4 + 4 + 8 + 8
_IMAGE_HEAD_BYTES = 4 + 7 * 8 + 4
_POINT_HEAD_BYTES = 8 + 3 * 8 + 3 + 8
_POINT2D_BYTES = 8 + 8 + 8
_TRACK_ELEMENT_BYTES = 4 + 4


@dataclass(frozen=True)
class ColmapModel:
    """Images with poses, and points with their observations.

    names: N image names. cam_from_world (N, 4, 4) float64. cameras: COLMAP's own (model name, width, height, params).
    points (P, 3) float64, colors (P, 3) uint8. Observations:
    obs_image (O,) and obs_point (O,) int indices into images and points, obs_xy (O, 2) float64 pixels, first pixel's
    centre at (0.5, 0.5).
    """

    names: tuple[str, ...]
    cam_from_world: NDArray[np.float64]
    cameras: tuple[tuple[str, int, int, tuple[float, ...]], ...]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    obs_image: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: NDArray[np.float64]


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read the registered images, in order of their names, and the points of a binary or text model in `folder`.

    Raises InputError when the folder holds no complete model, or a file of it is damaged or holds what cannot be:
    a pose that is no rigid transform, an image without a size, a value that is not finite.
    """
    folder = Path(folder)
    reconstruction = _load(folder)
    with parsing(folder, "COLMAP model"):
        model = _plain_model(reconstruction, folder)
    _require_sense(model, folder)
    return model


def _plain_model(reconstruction: Any, folder: Path) -> ColmapModel:
    images = sorted((reconstruction.images[i] for i in reconstruction.reg_image_ids()), key=lambda image: image.name)
    cameras = (reconstruction.cameras[i] for i in sorted({image.camera_id for image in images}))
    found = ModelArrays.of(reconstruction, [image.image_id for image in images])
    poses = [image.cam_from_world() for image in images]
    return ColmapModel(
        names=tuple(image.name for image in images),
        cam_from_world=poses_from_quaternions(
            np.array([pose.rotation.quat for pose in poses], dtype=np.float64).reshape(-1, 4),
            np.array([pose.translation for pose in poses], dtype=np.float64).reshape(-1, 3),
            str(folder),
        ),
        cameras=tuple((c.model.name, int(c.width), int(c.height), tuple(map(float, c.params))) for c in cameras),
        points=found.points,
        colors=np.array([reconstruction.points3D[i].color for i in found.point_ids.tolist()], np.uint8).reshape(-1, 3),
        obs_image=found.obs_cam,
        obs_point=found.obs_point,
        obs_xy=found.obs_xy,
    )


def _require_sense(model: ColmapModel, folder: Path) -> None:
    finite = all(
        np.isfinite(a).all() for a in (model.cam_from_world, model.obs_xy, *(np.array(c[3]) for c in model.cameras))
    )
    problems = {
        "an image name occurs twice": len(set(model.names)) == len(model.names),
        "a camera has no size": all(width > 0 and height > 0 for _, width, height, _ in model.cameras),
        "an observation's point is missing": bool((model.obs_point < len(model.points)).all()),
        "a value is not finite": finite and bool((np.abs(model.points) <= FARTHEST**2).all()),
    }
    for problem, holds in problems.items():
        if not holds:
            raise InputError(f"the COLMAP model in {folder} is damaged ({problem}): copy or export it again")


def _load(folder: Path) -> Any:
    import pycolmap  # half a second: only for those who read a model

    suffix = model_suffix(folder)
    if suffix is None:
        raise InputError(
            f"no complete COLMAP model in {folder}: expected cameras, images and points3D as .bin or as .txt "
            "(look in sparse/0)"
        )
    for part in _PARTS:
        # COLMAP's recipe for known poses begins with an empty points3D.txt.
        with opened(folder / f"{part}{suffix}", any_content=(part, suffix) == ("points3D", ".txt")):
            pass
    if suffix == ".bin":
        require_whole_files(folder)
    for part in ("rigs", "frames"):  # of newer models, where pycolmap finds poses first
        if (file := folder / f"{part}{suffix}").is_file():
            require_file(file)
    reconstruction = pycolmap.Reconstruction()
    with parsing(f"the COLMAP model in {folder}", "such model"):
        (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(str(folder))
        if suffix == ".txt":
            for number, name in names_in_text(folder / "images.txt").items():
                if " " in name:
                    reconstruction.images[int(number)].name = name
    return reconstruction


def write_colmap_model(folder: Path, model: ColmapModel) -> None:
    """Write cameras, images and points3D, binary and text, of images by one PINHOLE camera.

    Ids in the files count from 1, in the order given. Each point's error is the mean reprojection error of its
    observations, -1 without any. COLMAP's text format has no way to write blanks in a name: such names are whole in
    the binary files only.

    Raises ValueError for shapes or indices that do not fit together, InputError when the disk refuses.
    """
    _require_consistent(model)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with temporary_folder(folder / "model") as made:
            reconstruction = _reconstruction(model)
            reconstruction.write_text(made)
            reconstruction.write_binary(made)
            _require_written(made, model)
            # Binary last: readers look for it first, and must not find it before the rest is there.
            for name in (f"{part}{suffix}" for suffix in (".txt", ".bin") for part in _PARTS):
                with atomic_path(folder / name) as temporary:
                    os.replace(made / name, temporary)
    except OSError as error:
        raise explained(error, folder / "images.bin") from error


def _reconstruction(m: ColmapModel) -> pycolmap.Reconstruction:
    import pycolmap
    from scipy.spatial.transform import Rotation

    ((kind, width, height, params),) = m.cameras
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=kind, width=width, height=height, params=params, camera_id=_CAMERA_ID)
    made.add_camera_with_trivial_rig(camera)
    order = np.argsort(m.obs_image, kind="stable")
    starts = np.searchsorted(m.obs_image[order], np.arange(len(m.names) + 1))
    for i, rows in enumerate(order[a:b] for a, b in pairwise(starts)):
        rotation = Rotation.from_matrix(nearest_rotation(m.cam_from_world[i, :3, :3])).as_quat(canonical=True)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), m.cam_from_world[i, :3, 3])
        image = pycolmap.Image(name=m.names[i], keypoints=m.obs_xy[rows], camera_id=_CAMERA_ID, image_id=i + 1)
        made.add_image_with_trivial_frame(image, pose)
    features = np.empty(len(order), np.int64)
    features[order] = np.arange(len(order)) - starts[m.obs_image[order]]
    order = order[np.argsort(m.obs_point[order], kind="stable")]
    ends = np.searchsorted(m.obs_point[order], np.arange(len(m.points) + 1))
    for point, rows in enumerate(order[a:b] for a, b in pairwise(ends)):
        seen = zip((m.obs_image[rows] + 1).tolist(), features[rows].tolist(), strict=True)
        track = pycolmap.Track([pycolmap.TrackElement(image_id, k) for image_id, k in seen])
        made.add_point3D(m.points[point], track, m.colors[point])
    made.update_point_3d_errors()
    for number in np.flatnonzero(np.diff(ends) == 0).tolist():
        made.points3D[number + 1].error = -1
    return made


def _require_written(folder: Path, model: ColmapModel) -> None:
    """pycolmap reports no error on a full disk, and leaves truncated files."""
    lines = {"images.txt": 4 + 2 * len(model.names), "points3D.txt": 3 + len(model.points)}
    try:
        with noting_files():  # they are not what a stage was made from
            require_whole_files(folder)
        whole = all(sum(line[-1:] == b"\n" for line in (folder / n).open("rb")) == count for n, count in lines.items())
    except InputError:
        whole = False
    if not whole:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _require_consistent(m: ColmapModel) -> None:
    if [camera[0] for camera in m.cameras] != ["PINHOLE"]:
        raise ValueError(f"write_colmap_model: got cameras {m.cameras}, expected one of the model PINHOLE")
    n, p, o = len(m.names), len(m.points), len(m.obs_image)
    shapes = {"cam_from_world": (n, 4, 4), "points": (p, 3), "colors": (p, 3), "obs_point": (o,), "obs_xy": (o, 2)}
    for what, expected in shapes.items():
        if (got := getattr(m, what).shape) != expected:
            raise ValueError(f"write_colmap_model: {what}: got shape {got}, expected {expected}")
    if o and not (0 <= m.obs_image.min() <= m.obs_image.max() < n and 0 <= m.obs_point.min() <= m.obs_point.max() < p):
        raise ValueError("write_colmap_model: an observation points outside the images or points")
    if len(set(m.names)) != n or any(not name or "\n" in name or "\0" in name for name in m.names):
        raise ValueError("write_colmap_model: image names must be unique, not empty, and without line breaks")
    if not (np.isfinite(m.cam_from_world).all() and np.isfinite(m.points).all() and np.isfinite(m.obs_xy).all()):
        raise ValueError("write_colmap_model: got a value that is not finite")


@dataclass(frozen=True)
class ModelArrays:
    """Images, points and observations of a reconstruction.

    image_ids (N,), cam_from_world (N, 4, 4); point_ids (P,) in ascending order, points (P, 3) in the world; the
    observations of image after image: obs_cam (O,) int index into image_ids, obs_point (O,) int index into points,
    obs_feature (O,) int index into the image's features, obs_xy (O, 2) pixels.
    """

    image_ids: NDArray[np.int64]
    cam_from_world: Array
    point_ids: NDArray[np.int64]
    points: Array
    obs_cam: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_feature: NDArray[np.int64]
    obs_xy: Array

    @staticmethod
    def of(model: pycolmap.Reconstruction, image_ids: Sequence[int] | None = None) -> ModelArrays:
        """Read these images, or all that are registered in the order of their ids."""
        ids = sorted(model.reg_image_ids()) if image_ids is None else image_ids
        point_ids = np.array(sorted(model.point3D_ids()), np.int64)
        features, seen, xy = [], [], []
        for i in ids:
            features.append(model.images[i].get_observation_point2D_idxs())
            observed = model.images[i].get_observation_points2D()
            seen += [p.point3D_id for p in observed]
            xy += [p.xy for p in observed]
        return ModelArrays(
            np.array(ids, np.int64),
            _poses(model, ids),
            point_ids,
            _positions(model, point_ids.tolist()),
            np.repeat(np.arange(len(ids)), [len(f) for f in features]),
            np.searchsorted(point_ids, np.array(seen, np.int64)),
            np.array([k for f in features for k in f], np.int64),
            np.array(xy, np.float64).reshape(-1, 2),
        )

    def reread(self, model: pycolmap.Reconstruction) -> ModelArrays:
        """Read the poses and points that the model has by now; the observations stay."""
        poses, points = _poses(model, self.image_ids.tolist()), _positions(model, self.point_ids.tolist())
        return replace(self, cam_from_world=poses, points=points)

    def rows(self) -> list[slice]:
        """Return the observations of each image."""
        ends = np.searchsorted(self.obs_cam, np.arange(len(self.image_ids) + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]


def _poses(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> Array:
    poses = [pose_of(model.images[i]) for i in image_ids]
    return np.stack(poses) if poses else np.zeros((0, 4, 4))


def _positions(model: pycolmap.Reconstruction, point_ids: Sequence[int]) -> Array:
    return np.array([model.points3D[p].xyz for p in point_ids], np.float64).reshape(-1, 3)


def pose_of(image: pycolmap.Image) -> Array:
    """Return (4, 4) camera from world."""
    return np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])


def set_pose(model: pycolmap.Reconstruction, image_id: int, cam_from_world: Array) -> None:
    """Move an image of a model whose images are each a frame of their own; cam_from_world is (3, 4) or (4, 4)."""
    import pycolmap

    model.frames[model.images[image_id].frame_id].rig_from_world = pycolmap.Rigid3d(cam_from_world[:3])


# files --------------------------------------------------------------------------------------------------------------


def model_suffix(folder: Path) -> str | None:
    """Return ".bin" or ".txt" when the folder holds a complete model of that kind, else None."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in _PARTS):
            return suffix
    return None


def find_models(path: Path) -> list[Path]:
    """Return the folders of a project's models, that with most images first: a mapper leaves several where it could not
    connect all images. Of a folder that is a model itself, that folder; [] without any."""
    if model_suffix(path):
        return [path]
    for place in (path / name for name in _MODEL_PLACES):
        inside = sorted(place.iterdir()) if place.is_dir() else []
        found = [p for p in (place, *inside) if not p.name.startswith(".") and model_suffix(p)]
        if found:
            return sorted(found, key=_size_of_model, reverse=True)
    return []


def _size_of_model(folder: Path) -> int:
    """How many images it has, by its own word; 0 where it is damaged."""
    try:
        if model_suffix(folder) == ".txt":
            return len(names_in_text(folder / "images.txt"))
        with opened(folder / "images.bin") as file:
            return int.from_bytes(file.read(8), "little")
    except InputError:
        return 0


def names_in_text(path: Path) -> dict[str, str]:
    """Read the names in an images.txt by the images' ids, with their blanks: pycolmap reads a name up to its first."""
    names = {}
    with opened(path) as file:
        lines = (line.strip() for line in file)
        for line in lines:
            if line and not line.startswith(b"#"):
                words = line.split(maxsplit=9)
                if len(words) == 10:
                    names[words[0].decode("ascii", "replace")] = words[9].decode("utf-8", "surrogateescape")
                next(lines, None)  # its observations
    return names


def require_whole_files(folder: Path) -> None:
    """Walk through cameras.bin, images.bin and points3D.bin and check that each ends where its counts say.

    pycolmap trusts the counts: it reads on past the end of a truncated file, into wrong cameras or into as much
    memory as the machine has. Raises InputError naming the file.
    """
    for name, after in (("cameras", _after_camera), ("images", _after_image), ("points3D", _after_point)):
        path = folder / f"{name}.bin"
        data = read_bytes(path)
        with parsing(path, "whole file of a COLMAP model"):
            (count,), at = struct.unpack_from("<Q", data), 8
            for _ in range(count):
                at = after(data, at)
            if at != len(data):
                raise ValueError("it ends elsewhere than its counts say")


def _after_camera(data: bytes, at: int) -> int:
    (model,) = struct.unpack_from("<i", data, at + 4)
    return at + _CAMERA_HEAD_BYTES + 8 * _PARAMETER_COUNTS[model]


def _after_image(data: bytes, at: int) -> int:
    at = data.index(b"\0", at + _IMAGE_HEAD_BYTES) + 1
    (points,) = struct.unpack_from("<Q", data, at)
    return at + 8 + _POINT2D_BYTES * int(points)


def _after_point(data: bytes, at: int) -> int:
    (track,) = struct.unpack_from("<Q", data, at + _POINT_HEAD_BYTES)
    return at + _POINT_HEAD_BYTES + 8 + _TRACK_ELEMENT_BYTES * int(track)


def cameras_in(data: bytes) -> Iterator[tuple[int, int, int, int, tuple[float, ...]]]:
    """Read id, number of the model, width, height and parameters of each camera of a cameras.bin. Raises struct.error
    and KeyError for damage."""
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        head = struct.unpack_from("<IiQQ", data, at)
        params = struct.unpack_from(f"<{_PARAMETER_COUNTS[head[1]]}d", data, at + _CAMERA_HEAD_BYTES)
        at += _CAMERA_HEAD_BYTES + 8 * len(params)
        yield *head, params
