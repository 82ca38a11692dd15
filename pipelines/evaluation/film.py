"""The finished map as a film or as images: along the run's own path, the same smoothed, an orbit or a recorded one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ...formats.errors import InputError, install_extra
from ...formats.images import write_rgb
from ...formats.textfile import number, read_json_object
from ...formats.video_streams import CODECS, PLAYED, write_browser_video, write_video
from ..export.web_page import EXPORTED, RUN
from ..run.folder import RunFolder
from ..run.outcome import Outcome, load_outcome
from ..run.target import Target
from ..scene.world import WORLD, up_in_run
from ..source.recording import is_of_source
from ..system.progress import Progress, SilentProgress, log
from ..system.wording import quoted
from ..types import Array, Intrinsics
from .views import Picture, common_depth_range, depth_picture, label_picture, render_outcome

_ALL_ROUND, _LEAST_ARC = np.radians(270), np.radians(20)
"""An arc of cameras from which an orbit goes all the way: what the rest would see, others saw from beside it; and the
arc of a camera that hardly moved sideways."""

KINDS = ("color", "depth", "labels")
PATHS = ("own", "smooth", "orbit")
_SMOOTHING_SECONDS = 0.5
_MAX_GAP, _MAX_OF_PHOTOS = 1.0, 60.0
"""Seconds of film between two neighbouring frames, and of a film along photos, which may be days apart."""
_IMAGE_NAME = re.compile(r"\d{6,}\.png")
_FILE_SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,4}")

_FORMAT = "msgs-slam camera path 1"
_LIMITS = {"fps": (0.1, 240.0), "seconds_per_keyframe": (0.05, 600.0), "fov_degrees": (1.0, 170.0)}
_MAX_KEYFRAMES, _MAX_IMAGES = 1000, 100_000
_AGAIN = "correct it, or record the path again in `msgs-slam view`"


def render_run(
    run: RunFolder,
    target: Path,
    kind: str = "color",
    path: str | Path = "smooth",
    fps: float | None = None,
    progress: Progress | None = None,
    size: tuple[int, int] | None = None,
    tell: Callable[[str], None] = log.info,
    overwrite: bool = False,
) -> Path:
    """Draw the map along a path into a video (.mp4, .avi, .mkv) or, for a name without a suffix, a folder of PNG files.

    kind: one of `KINDS`; path: one of `PATHS`, or the file of a camera path, which takes as long as the walk took (of
    photos: a second each at most, a minute in all; an orbit: ten seconds; a file: as long as it says); fps: None = 30,
    or as the file says; size: (width, height) of an image, by default the run's; tell: is given the length of the film
    before the first image is drawn; overwrite: whether other files than those of an earlier call may be replaced.
    Returns `target`; where browsers will not play the video, a warning says so. Raises InputError for an unknown kind
    or path, a bad file, a run without a map, or a target that holds files of others.
    """
    if kind not in KINDS:
        raise InputError(f"kind is one of {', '.join(KINDS)}; got {kind!r}")
    if is_of_source(target, run):
        raise InputError(f"{target} is the source of {run.root}: name another file or folder")
    place = _target(target, 30.0 if fps is None else fps, overwrite)
    if path not in PATHS and not Path(path).is_file():
        kinds = f"{', '.join(PATHS)}, or a camera path that `msgs-slam view` has saved"
        raise InputError(f"path is one of {kinds}; there is no file {str(path)!r}")
    given = None if path in PATHS else read_camera_path(Path(path), fps)
    rate = given.fps if given else 30.0 if fps is None else fps
    flight = None if given is None else given.in_world_of_run(run)
    outcome = load_outcome(run)
    outcome.require_map()
    if size is not None:
        outcome = _seen_by(outcome, outcome.calibration.intrinsics.of_size(*size))
    near, far = common_depth_range(outcome)
    if flight is None:
        views = [(outcome, pose) for pose in _path(outcome, str(path), rate, (near * far) ** 0.5)]
    else:
        views = [(_with_fov(outcome, fov), pose) for pose, fov in zip(*flight, strict=True)]
    tell(f"rendering {len(views)} images: a film of {len(views) / rate:.0f} s at {rate:g} images a second")
    steps = (progress or SilentProgress()).track(views, "rendering", len(views))
    return _write(place, target, (_draw(seen, pose, kind, near, far) for seen, pose in steps), rate)


def _target(target: Path, fps: float, overwrite: bool) -> Target:
    """The folder that a film or its images are written into. Raises InputError for another suffix than a film's, a rate
    out of range, and where files of others are in the way."""
    if not 0.1 <= fps <= 240:
        raise InputError(f"--fps is 0.1 to 240 frames a second; got {fps}")
    suffix = target.suffix.lower()
    if suffix not in CODECS and not target.is_dir() and (target.is_file() or _FILE_SUFFIX.fullmatch(suffix)):
        what = "is a file" if target.is_file() else f"cannot be written as {suffix}"
        raise InputError(f"{target} {what}: name a video that ends in {', '.join(CODECS)}, or a folder for PNG images")
    place = Target(target.parent if suffix in CODECS else target, overwrite)
    place.require(_belongs(target))
    return place


def _belongs(target: Path) -> Callable[[str], bool]:
    """Which names of a folder are those of the film, or of its images."""
    if target.suffix.lower() in CODECS:
        return target.name.__eq__
    return lambda name: _IMAGE_NAME.fullmatch(name) is not None


def _write(place: Target, target: Path, pictures: Iterator[Picture], fps: float) -> Path:
    with place.replacing(_belongs(target)) as staged:
        if (kind := target.suffix.lower()) not in CODECS:
            for index, picture in enumerate(pictures):
                write_rgb(staged.path(f"{index:06d}.png"), picture)
        elif kind != ".mp4":
            write_video(staged.path(target.name), pictures, fps)
        elif (codec := write_browser_video(staged.path(target.name), pictures, fps)) not in PLAYED:
            log.warning(
                "%s is %s, which browsers do not play: nothing here writes H.264 or VP9. %s",
                target, codec, install_extra("hdr"),
            )  # fmt: skip
    return target


def _with_fov(outcome: Outcome, fov: float) -> Outcome:
    """The same seen by a camera with this field of view from top to bottom, in degrees."""
    k = outcome.calibration.intrinsics
    fy = k.height / 2 / float(np.tan(np.radians(fov) / 2))
    return _seen_by(outcome, replace(k, fx=k.fx * fy / k.fy, fy=fy))


def _seen_by(outcome: Outcome, camera: Intrinsics) -> Outcome:
    return replace(outcome, calibration=replace(outcome.calibration, intrinsics=camera))


def _path(outcome: Outcome, path: str, fps: float, scene_depth: float) -> Array:
    t = outcome.trajectory
    own = t.world_from_cam[t.is_posed]
    times = t.timestamps[t.is_posed]
    if path == "orbit":
        return orbit(own, scene_depth, round(10 * fps), up_in_run(outcome))
    seconds = film_seconds(times) if len(times) > 1 else 1.0
    dense = resampled(own, max(2, round(seconds * fps)))
    return dense if path == "own" else smoothed(dense, _SMOOTHING_SECONDS * len(dense) / max(seconds, 1e-6))


def film_seconds(times: Array) -> float:
    """Length in seconds of a film along frames taken at `times` (N,) seconds: their own, without gaps above a second;
    of photos, which have such gaps throughout, at most a minute."""
    gaps = np.diff(times)
    seconds = float(np.minimum(gaps, _MAX_GAP).sum())
    return min(seconds, _MAX_OF_PHOTOS) if np.median(gaps) >= _MAX_GAP else seconds


def _draw(outcome: Outcome, world_from_cam: Array, kind: str, near: float, far: float) -> Picture:
    view = render_outcome(outcome, np.asarray(np.linalg.inv(world_from_cam), np.float64))
    if kind == "depth":
        return depth_picture(view.depth, near, far)
    return view.exposed(None, 0.0) if kind == "color" else label_picture(view.labels, outcome.classes.colors)


def resampled(world_from_cam: Array, count: int) -> Array:
    """(count, 4, 4) poses evenly along the path in frames: centres linear, rotations on the shortest arc."""
    if len(world_from_cam) < 2:
        return np.repeat(world_from_cam, count, axis=0)
    at, known = np.linspace(0, len(world_from_cam) - 1, count), np.arange(len(world_from_cam))
    centers = np.stack([np.interp(at, known, world_from_cam[:, k, 3]) for k in range(3)], axis=1)
    return _poses(Slerp(known, Rotation.from_matrix(world_from_cam[:, :3, :3]))(at).as_matrix(), centers)


def smoothed(world_from_cam: Array, sigma: float) -> Array:
    """(N, 4, 4) the path without the tremble of the hand: Gaussian means over `sigma` frames."""
    quat_xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()
    # q and -q are one rotation; neighbours must have the same sign before they are averaged.
    flips = np.cumprod(np.concatenate([[1.0], np.where((quat_xyzw[1:] * quat_xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0)]))
    mean_quat = gaussian_filter1d(quat_xyzw * flips[:, None], sigma, axis=0, mode="nearest")
    centers = gaussian_filter1d(world_from_cam[:, :3, 3], sigma, axis=0, mode="nearest")
    return _poses(Rotation.from_quat(mean_quat).as_matrix(), centers)


def _poses(rotations: Array, centers: Array) -> Array:
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, centers
    return poses


def orbit(world_from_cam: Array, scene_depth: float, count: int, up: Array) -> Array:
    """(count, 4, 4) round the place the cameras look at, at their usual distance and height: once round where they
    stood on all sides of it, else back and forth over the arc from which they saw it.

    scene_depth: the usual distance of the scene, which stands in where the cameras do not look at one place; up (3,)
    unit vector in the world.
    """
    focus, radius, height = _focus(world_from_cam, up, scene_depth)
    first = np.linalg.svd(up[None])[2][1]
    second = np.cross(up, first)
    away = world_from_cam[:, :3, 3] - focus
    start, arc = _arc(np.arctan2(away @ second, away @ first))
    share = np.arange(count) / count
    turns = share if arc >= _ALL_ROUND else (1 - np.cos(2 * np.pi * share)) / 2
    angle = start + (2 * np.pi if arc >= _ALL_ROUND else arc) * turns
    centers = focus + radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second) + height * up
    return _facing(centers, focus, up)


def _arc(angles: Array) -> tuple[float, float]:
    """Where the shortest arc around all of these angles begins, and its length, which is `_LEAST_ARC` at least."""
    angles = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    arc = float(2 * np.pi - gaps[widest])
    beyond = max(_LEAST_ARC - arc, 0) / 2
    return float(angles[(widest + 1) % len(angles)]) - beyond, arc + 2 * beyond


def _focus(world_from_cam: Array, up: Array, scene_depth: float) -> tuple[Array, float, float]:
    """(point nearest to all optical axes, usual horizontal distance to it, usual height above it)."""
    centers, axes = world_from_cam[:, :3, 3], world_from_cam[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A little pull to the usual depth settles what parallel axes leave open.
    usual = (centers + scene_depth * axes).mean(axis=0)
    matrix = across.sum(axis=0) + 0.05 * len(axes) * np.eye(3)
    focus = np.linalg.solve(matrix, (across @ centers[:, :, None]).sum(axis=0)[:, 0] + 0.05 * len(axes) * usual)
    if np.median(((focus - centers) * axes).sum(axis=1)) < 0.2 * scene_depth:
        focus = usual
    away = centers - focus
    heights = away @ up
    radius = float(np.median(np.linalg.norm(away - heights[:, None] * up, axis=1)))
    return focus, max(radius, 0.3 * scene_depth), float(np.median(heights))


def _facing(centers: Array, target: Array, up: Array) -> Array:
    forward = target - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return _poses(np.stack([right, np.cross(forward, right), forward], axis=2), centers)


@dataclass(frozen=True)
class CameraPath:
    """Keyframes the same time apart in `world`, EXPORTED or RUN: world_from_cam (K, 4, 4), x right, y down, z forward,
    and fields of view (K,) from top to bottom in degrees; fps: images per second."""

    world_from_cam: Array
    fovs: Array
    fps: float
    seconds_per_keyframe: float
    world: str

    def flight(self) -> tuple[Array, Array]:
        """(N, 4, 4) world_from_cam by a Catmull-Rom spline and shortest arcs, and (N,) fields of view in degrees."""
        known = np.arange(len(self.fovs))
        at, centers = np.linspace(0, known[-1], self.image_count), self.world_from_cam[:, :3, 3]
        rotations = Slerp(known, Rotation.from_matrix(self.world_from_cam[:, :3, :3]))(at)
        # Central differences as tangents make a cubic Hermite spline a Catmull-Rom spline.
        poses = _poses(rotations.as_matrix(), CubicHermiteSpline(known, centers, np.gradient(centers, axis=0))(at))
        return poses, np.interp(at, known, self.fovs)

    def in_world_of_run(self, run: RunFolder) -> tuple[Array, Array]:
        """Return the flight in the run's own world. Raises InputError for a run without the exported world."""
        poses, fovs = self.flight()
        if self.world == RUN:
            return poses, fovs
        if (world := run.find(WORLD)) is None:
            raise InputError(
                f"the camera path is in the coordinates of exported files, and {run.root} has none: "
                f"run `msgs-slam resume {quoted(run.root)}` first"
            )
        cam_from_run = world.exported_from_run.inverse().apply_to_poses(np.linalg.inv(poses))
        return np.asarray(np.linalg.inv(cam_from_run), np.float64), fovs

    @property
    def image_count(self) -> int:
        """The number of images of the flight, both ends included."""
        return max(2, round((len(self.fovs) - 1) * self.seconds_per_keyframe * self.fps) + 1)


def read_camera_path(path: Path, fps: float | None = None) -> CameraPath:
    """Read a path that the map's page has saved, or a person has written; `fps` replaces the file's images per second.

    Raises InputError, with the entry that is wrong, for anything that cannot be flown along.
    """
    value = read_json_object(path)
    if value.get("format") != _FORMAT:
        found = str(value.get("format"))[:40]
        raise InputError(
            f"{path} is no camera path: its format is {found!r}, expected {_FORMAT!r}. {_AGAIN[0].upper()}{_AGAIN[1:]}"
        )
    if (world := value.get("world")) not in (EXPORTED, RUN):
        raise InputError(f"{path}: world is {str(world)[:40]!r}, expected {EXPORTED!r} or {RUN!r}: {_AGAIN}")
    rows = value.get("keyframes")
    if not isinstance(rows, list) or not 2 <= len(rows) <= _MAX_KEYFRAMES:
        count = len(rows) if isinstance(rows, list) else "no list of"
        raise InputError(f"{path} has {count} keyframes, expected 2 to {_MAX_KEYFRAMES}: {_AGAIN}")
    poses, fovs = zip(*(_keyframe(path, i, row) for i, row in enumerate(rows, 1)), strict=True)
    rate, seconds = fps or _limited(value, path, "fps"), _limited(value, path, "seconds_per_keyframe")
    found_path = CameraPath(np.stack(poses), np.array(fovs), rate, seconds, str(world))
    if (count := found_path.image_count) > _MAX_IMAGES:
        raise InputError(
            f"{path}: the flight has {count:,} images, at most {_MAX_IMAGES:,}: "
            "lower fps or seconds_per_keyframe, or split the path"
        )
    return found_path


def _keyframe(path: Path, index: int, row: Any) -> tuple[Array, float]:
    where = f"{path}: keyframe {index}"
    if not isinstance(row, dict):
        raise InputError(f"{where} is {str(row)[:40]!r}, expected an object in braces: {_AGAIN}")
    for name, length in (("position", 3), ("rotation_wxyz", 4)):
        value = row.get(name)
        if not isinstance(value, list) or [type(v) in (int, float) for v in value] != [True] * length:
            raise InputError(f"{where}: {name} is {str(value)[:60]!r}, expected {length} numbers: {_AGAIN}")
    wxyz, position = np.array(row["rotation_wxyz"], np.float64), np.array(row["position"], np.float64)
    if not 0.9 < np.linalg.norm(wxyz) < 1.1:
        raise InputError(f"{where}: rotation_wxyz is no unit quaternion (w, x, y, z): {_AGAIN}")
    pose = _poses(Rotation.from_quat(wxyz[None, [1, 2, 3, 0]]).as_matrix(), position[None])[0]
    return pose, _limited(row, Path(where), "fov_degrees")


def _limited(table: dict[str, Any], path: Path, name: str) -> float:
    value, (low, high) = number(table, path, name), _LIMITS[name]
    if not low <= value <= high:
        raise InputError(f"{path}: {name} is {value:g}, expected {low:g} to {high:g}: {_AGAIN}")
    return value
