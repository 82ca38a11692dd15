"""COLMAP models: written in the format every version and every splatting trainer reads, read by pycolmap.

pycolmap 4.2's own writers report no error on a full disk and leave truncated files, so writing is ours.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .atomic import write_bytes, write_lines, write_text
from .colmap_files import model_suffix, names_in_text, require_whole_files
from .errors import InputError
from .ply import slices
from .reading import opened, parsing, require_file
from .trajectory import FARTHEST, nearest_rotation, poses_from_quaternions

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

_PINHOLE_MODEL_ID = 1
_CAMERA_ID = 1
_POINT2D = np.dtype([("xy", "<f8", 2), ("point3D_id", "<u8")])
_TRACK_ELEMENT = np.dtype([("image_id", "<u4"), ("point2D_idx", "<u4")])


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


def write_colmap_model(folder: Path, model: ColmapModel) -> None:
    """Write cameras, images and points3D, binary and text, of images by one PINHOLE camera.

    Ids in the files count from 1, in the order given. Each point's error is the mean reprojection error of its
    observations, -1 without any. COLMAP's text format has no way to write blanks in a name: such names are whole in
    the binary files only.

    Raises ValueError for shapes or indices that do not fit together, InputError when the disk refuses.
    """
    _require_consistent(model)
    camera, errors, images = _camera(model), _point_errors(model), _Images.from_model(model)
    tracks = _tracks(images, len(model.points))
    points = (model.points, model.colors, errors, tracks)
    folder = Path(folder)
    # Binary last: readers look for it first, and must not find it before the rest is there.
    write_text(folder / "cameras.txt", _cameras_text(camera))
    write_lines(folder / "images.txt", _images_text(images))
    write_lines(folder / "points3D.txt", _points_text(*points))
    write_bytes(folder / "cameras.bin", _cameras_binary(camera))
    write_bytes(folder / "images.bin", _images_binary(images))
    write_bytes(folder / "points3D.bin", _points_binary(*points))


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
    for part in ("cameras", "images", "points3D"):
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


@dataclass(frozen=True)
class _Images:
    """What images.* holds: per image a name, a pose, and the slice starts[i]:starts[i+1] of the observations."""

    names: tuple[str, ...]
    quat_wxyz: NDArray[np.float64]
    translations: NDArray[np.float64]
    starts: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: NDArray[np.float64]

    @staticmethod
    def from_model(m: ColmapModel) -> _Images:
        from scipy.spatial.transform import Rotation

        order = np.argsort(m.obs_image, kind="stable")
        starts = np.searchsorted(m.obs_image[order], np.arange(len(m.names) + 1)).astype(np.int64)
        rotations = nearest_rotation(m.cam_from_world[:, :3, :3])
        quat_xyzw = Rotation.from_matrix(rotations).as_quat(canonical=True) if len(m.names) else np.zeros((0, 4))
        quat_wxyz, translations = quat_xyzw[:, [3, 0, 1, 2]], m.cam_from_world[:, :3, 3]
        return _Images(tuple(m.names), quat_wxyz, translations, starts, m.obs_point[order], m.obs_xy[order])


@dataclass(frozen=True)
class _Tracks:
    """Per point the slice starts[p]:starts[p+1] of (image_id, point2D_idx)."""

    starts: NDArray[np.int64]
    elements: NDArray


def _tracks(images: _Images, point_count: int) -> _Tracks:
    counts = np.diff(images.starts)
    elements = np.empty(len(images.obs_point), dtype=_TRACK_ELEMENT)
    elements["image_id"] = np.repeat(np.arange(1, len(counts) + 1), counts)
    elements["point2D_idx"] = np.arange(len(images.obs_point)) - np.repeat(images.starts[:-1], counts)
    order = np.argsort(images.obs_point, kind="stable")
    starts = np.searchsorted(images.obs_point[order], np.arange(point_count + 1)).astype(np.int64)
    return _Tracks(starts, elements[order])


def _camera(model: ColmapModel) -> tuple[int, int, float, float, float, float]:
    """Width, height, fx, fy, cx, cy of its one camera."""
    ((kind, width, height, parameters),) = model.cameras
    fx, fy, cx, cy = parameters
    if kind != "PINHOLE":
        raise ValueError(f"write_colmap_model: got a camera of the model {kind}, expected PINHOLE")
    return width, height, fx, fy, cx, cy


def _point_errors(model: ColmapModel) -> NDArray[np.float64]:
    """(P,) mean reprojection error in pixels, -1 for a point without observations, as COLMAP has it."""
    _, _, fx, fy, cx, cy = _camera(model)
    points, obs_point, obs_xy = model.points, model.obs_point, model.obs_xy
    distance = np.zeros(len(obs_xy))
    for rows in slices(len(obs_xy)):  # a pose for each observation is the largest thing here
        transforms = model.cam_from_world[model.obs_image[rows]]
        in_cam = np.einsum("oij,oj->oi", transforms[:, :3, :3], points[obs_point[rows]]) + transforms[:, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            projected = in_cam[:, :2] / in_cam[:, 2:] * [fx, fy] + [cx, cy]
        distance[rows] = np.nan_to_num(np.linalg.norm(projected - obs_xy[rows], axis=1), nan=0.0, posinf=0.0)
    counts = np.bincount(obs_point, minlength=len(points))
    total = np.bincount(obs_point, distance, minlength=len(points))
    return np.where(counts > 0, total / np.maximum(counts, 1), -1.0)


def _cameras_text(camera: tuple[int, int, float, float, float, float]) -> str:
    width, height, *parameters = camera
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}{_CAMERA_ID} PINHOLE {width} {height} {_numbers(parameters)}\n"


def _images_text(images: _Images) -> Iterator[str]:
    yield "# Image list with two lines of data per image:"
    yield "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "#   POINTS2D[] as (X, Y, POINT3D_ID)"
    for i, name in enumerate(images.names):
        here = slice(images.starts[i], images.starts[i + 1])
        pose = _numbers([*images.quat_wxyz[i], *images.translations[i]])
        yield f"{i + 1} {pose} {_CAMERA_ID} {name}"
        pairs = zip(images.obs_xy[here].tolist(), images.obs_point[here].tolist(), strict=True)
        yield " ".join(f"{x!r} {y!r} {point + 1}" for (x, y), point in pairs)


def _points_text(
    points: NDArray[np.float64], colors: NDArray[np.uint8], errors: NDArray[np.float64], tracks: _Tracks
) -> Iterator[str]:
    yield "# 3D point list with one line of data per point:"
    yield "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    for p, (xyz, rgb) in enumerate(zip(points, colors, strict=True)):
        elements = tracks.elements[tracks.starts[p] : tracks.starts[p + 1]].tolist()
        track = " ".join(f"{image} {index}" for image, index in elements)
        yield f"{p + 1} {_numbers(xyz)} {rgb[0]} {rgb[1]} {rgb[2]} {float(errors[p])!r} {track}".rstrip()


def _cameras_binary(camera: tuple[int, int, float, float, float, float]) -> bytes:
    width, height, *parameters = camera
    return struct.pack("<QIiQQ4d", 1, _CAMERA_ID, _PINHOLE_MODEL_ID, width, height, *parameters)


def _images_binary(images: _Images) -> bytes:
    points2d = np.empty(len(images.obs_point), dtype=_POINT2D)
    points2d["xy"] = images.obs_xy
    points2d["point3D_id"] = images.obs_point + 1
    parts = [struct.pack("<Q", len(images.names))]
    for i, name in enumerate(images.names):
        here = points2d[images.starts[i] : images.starts[i + 1]]
        parts.append(struct.pack("<I7dI", i + 1, *images.quat_wxyz[i], *images.translations[i], _CAMERA_ID))
        parts.append(name.encode("utf-8") + b"\0" + struct.pack("<Q", len(here)) + here.tobytes())
    return b"".join(parts)


def _points_binary(
    points: NDArray[np.float64], colors: NDArray[np.uint8], errors: NDArray[np.float64], tracks: _Tracks
) -> bytes:
    parts = [struct.pack("<Q", len(points))]
    for p in range(len(points)):
        track = tracks.elements[tracks.starts[p] : tracks.starts[p + 1]]
        parts.append(struct.pack("<Q3d3BdQ", p + 1, *points[p], *colors[p].tolist(), errors[p], len(track)))
        parts.append(track.tobytes())
    return b"".join(parts)


def _numbers(values: list[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _require_consistent(m: ColmapModel) -> None:
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
