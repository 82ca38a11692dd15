"""The finished map as a video or as images, along the run's own path, the same smoothed, an orbit or another."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from ...formats.errors import InputError, install_extra
from ...formats.images import write_rgb
from ...formats.splats import read_gaussians
from ...formats.video_writer import CODECS, PLAYED, write_browser_video, write_video
from ..evaluation.views import (
    Picture,
    SplatScene,
    depth_picture,
    depth_range,
    draw_splats,
    label_picture,
    render_outcome,
)
from ..outcome import Outcome, load_outcome
from ..run.folder import RunFolder
from ..run.target import Target
from ..scene.world import WORLD, up_in_run
from ..source.recording import is_of_source
from ..system.progress import Progress, SilentProgress, log
from ..system.wording import quoted
from ..types import Intrinsics
from .camera_path import RUN, SPLATS, CameraPath, read_camera_path
from .scene import UP_OF_SPLATS

Array = NDArray[np.float64]

_FROM_OUTSIDE = 1.4
"""Sizes of a scene that one stands away from its middle: then it fills most of an image of 50 degrees."""

_ALL_ROUND, _LEAST_ARC = np.radians(270), np.radians(20)
"""An arc of cameras from which an orbit goes all the way: what the rest would see, others saw from beside it; and the
arc of a camera that hardly moved sideways."""

KINDS = ("color", "depth", "labels", "side-by-side")
PATHS = ("own", "smooth", "orbit")
_SMOOTHING_SECONDS = 0.5
_MAX_GAP, _MAX_OF_PHOTOS = 1.0, 60.0
"""Seconds of film between two neighbouring frames, and of a film along photos, which may be days apart."""
_IMAGE_NAME = re.compile(r"\d{6,}\.png")
_FILE_SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,4}")
_FILE_SIZE, _FIELD_OF_VIEW = (960, 540), 50.0
"""Of images of a splat file, which stores no cameras: the field of view is from top to bottom, in degrees."""


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
    rate = 30.0 if fps is None else fps
    if is_of_source(target, run):
        raise InputError(f"{target} is the source of {run.root}: name another file or folder")
    place = _target(target, rate, overwrite)
    given = _given_path(path, fps)
    flown = None if given is None else _in_world_of_run(given, run)
    outcome = load_outcome(run)
    outcome.require_map()
    outcome = outcome if size is None else _of_size(outcome, size)
    near, far = _depth_range(outcome)
    if flown is None:
        poses = _path(outcome, str(path), rate, (near * far) ** 0.5)
        views = [(outcome, pose) for pose in poses]
    else:
        views = [(_seeing(outcome, fov), pose) for pose, fov in zip(*flown, strict=True)]
    rate = rate if given is None else given.fps
    tell(_length(len(views), rate))
    steps = (progress or SilentProgress()).track(views, "rendering", len(views))
    return _write(place, target, (_draw(seen, pose, kind, near, far) for seen, pose in steps), rate)


def _length(count: int, fps: float) -> str:
    return f"rendering {count} images: a film of {count / fps:.0f} s at {fps:g} images a second"


def render_file(
    source: Path,
    target: Path,
    fps: float | None = None,
    progress: Progress | None = None,
    size: tuple[int, int] | None = None,
    path: str | Path = "orbit",
    tell: Callable[[str], None] = log.info,
    overwrite: bool = False,
) -> Path:
    """Draw a splat file by any program along a circle round it, or the camera path in the file `path`, otherwise as
    `render_run`; by default 960x540.

    Raises InputError for a file that cannot be read or is empty, or a camera path in the world of a run.
    """
    rate = 30.0 if fps is None else fps
    place = _target(target, rate, overwrite)
    given = _of_file(_given_path(path, fps), path, source)
    cloud = read_gaussians(source)
    if len(cloud) == 0:
        raise InputError(f"{source}: contains no Gaussians: nothing can be drawn. Export it again")
    scene, (width, height) = SplatScene.of(cloud), size or _FILE_SIZE
    if given is None:
        poses = around(scene.middle, scene.size, UP_OF_SPLATS, round(10 * rate))
        fovs = np.full(len(poses), _FIELD_OF_VIEW)
    else:
        (poses, fovs), rate = given.flight(), given.fps
    cameras = [_camera(width, height, fov) for fov in fovs]
    tell(_length(len(poses), rate))
    steps = (progress or SilentProgress()).track(range(len(poses)), "rendering", len(poses))
    return _write(place, target, (draw_splats(scene, cameras[i], np.linalg.inv(poses[i])) for i in steps), rate)


def _camera(width: int, height: int, fov: float) -> Intrinsics:
    focal = height / 2 / np.tan(np.radians(fov) / 2)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def _of_file(path: CameraPath | None, file: str | Path, source: Path) -> CameraPath | None:
    """The path in the world of the splat file `source`: one that was recorded in the run is turned where world.json
    beside that says how."""
    if path is not None and path.world == RUN:
        raise InputError(
            f"{file} was recorded in a run before its export, in other coordinates than a splat file has: give the run "
            "instead of the splat file, or record the path again"
        )
    if path is None or path.world == SPLATS or not (beside := source.with_name(WORLD.name)).is_file():
        return path
    return _turned(path, WORLD.read(beside).image_axes_from_exported)


def _turned(path: CameraPath, rotation: Array) -> CameraPath:
    motion = np.eye(4)
    motion[:3, :3] = rotation
    keyframes = tuple(replace(key, world_from_cam=motion @ key.world_from_cam) for key in path.keyframes)
    return replace(path, keyframes=keyframes)


def _given_path(path: str | Path, fps: float | None) -> CameraPath | None:
    """The camera path in a file; None for a name of `PATHS`."""
    if path in PATHS:
        return None
    if not Path(path).is_file():
        raise InputError(
            f"path is one of {', '.join(PATHS)}, or a camera path that `msgs-slam view` has saved; there is no file "
            f"{str(path)!r}"
        )
    return read_camera_path(Path(path), fps)


def _in_world_of_run(path: CameraPath, run: RunFolder) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The flight in the run's own world: (N, 4, 4) world_from_cam, (N,) fields of view in degrees."""
    if path.world == RUN:
        return path.flight()
    if (world := run.find(WORLD)) is None:
        raise InputError(
            f"the camera path is in the coordinates of exported files, and {run.root} has none: "
            f"run `msgs-slam resume {quoted(run.root)}` first"
        )
    if path.world == SPLATS:
        path = _turned(path, world.image_axes_from_exported.T)
    poses, fovs = path.flight()
    cam_from_run = world.exported_from_run.inverse().apply_to_poses(np.linalg.inv(poses))
    return np.asarray(np.linalg.inv(cam_from_run), np.float64), fovs


def _seeing(outcome: Outcome, fov: float) -> Outcome:
    """The same seen by a camera with this field of view from top to bottom, in degrees."""
    k = outcome.calibration.intrinsics
    fy = k.height / 2 / float(np.tan(np.radians(fov) / 2))
    zoomed = replace(k, fx=k.fx * fy / k.fy, fy=fy)
    return replace(outcome, calibration=replace(outcome.calibration, intrinsics=zoomed))


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
            for number, picture in enumerate(pictures):
                write_rgb(staged / f"{number:06d}.png", picture)
        elif kind != ".mp4":
            write_video(staged / target.name, pictures, fps)
        elif (codec := write_browser_video(staged / target.name, pictures, fps)) not in PLAYED:
            log.warning(
                "%s is %s, which browsers do not play: nothing here writes H.264 or VP9. %s",
                target, codec, install_extra("hdr"),
            )  # fmt: skip
    return target


def _of_size(outcome: Outcome, size: tuple[int, int]) -> Outcome:
    """The same seen by a camera with so many pixels: of another shape it sees more or less at the sides, and the same
    from top to bottom."""
    k = outcome.calibration.intrinsics
    width, height = size
    scale = height / k.height
    fx, fy, cx, cy = k.fx * scale, k.fy * scale, k.cx * scale + (width - k.width * scale) / 2, k.cy * scale
    return replace(
        outcome, calibration=replace(outcome.calibration, intrinsics=Intrinsics(width, height, fx, fy, cx, cy))
    )


def _path(outcome: Outcome, path: str, fps: float, scene_depth: float) -> NDArray[np.float64]:
    t = outcome.trajectory
    own = t.world_from_cam[t.is_posed]
    times = t.timestamps[t.is_posed]
    if path == "orbit":
        return orbit(own, scene_depth, round(10 * fps), up_in_run(outcome))
    seconds = film_seconds(times) if len(times) > 1 else 1.0
    dense = resampled(own, max(2, round(seconds * fps)))
    return dense if path == "own" else smoothed(dense, _SMOOTHING_SECONDS * len(dense) / max(seconds, 1e-6))


def film_seconds(times: NDArray[np.float64]) -> float:
    """Length in seconds of a film along frames taken at `times` (N,) seconds: their own, without gaps above a second;
    of photos, which have such gaps throughout, at most a minute."""
    gaps = np.diff(times)
    seconds = float(np.minimum(gaps, _MAX_GAP).sum())
    return min(seconds, _MAX_OF_PHOTOS) if np.median(gaps) >= _MAX_GAP else seconds


def _depth_range(outcome: Outcome) -> tuple[float, float]:
    """One range of colours for the whole video, from a few of the run's views."""
    poses = outcome.trajectory.cam_from_world[outcome.trajectory.is_posed]
    chosen = poses[np.linspace(0, len(poses) - 1, min(5, len(poses))).astype(int)]
    ranges = np.array([depth_range(render_outcome(outcome, pose).depth) for pose in chosen])
    return float(ranges[:, 0].min()), float(ranges[:, 1].max())


def _draw(outcome: Outcome, world_from_cam: NDArray[np.float64], kind: str, near: float, far: float) -> Picture:
    view = render_outcome(outcome, np.asarray(np.linalg.inv(world_from_cam), np.float64))
    pictures = {
        "color": lambda: view.exposed(None, 0.0),
        "depth": lambda: depth_picture(view.depth, near, far),
        "labels": lambda: label_picture(view.labels, outcome.classes.colors),
    }
    if kind == "side-by-side":
        return np.concatenate([draw() for draw in pictures.values()], axis=1)
    return pictures[kind]()


def resampled(world_from_cam: Array, count: int) -> Array:
    """(count, 4, 4) poses evenly along the path in frames: centres linear, rotations on the shortest arc."""
    if len(world_from_cam) < 2:
        return np.repeat(world_from_cam, count, axis=0)
    at = np.linspace(0, len(world_from_cam) - 1, count)
    known = np.arange(len(world_from_cam))
    path = np.tile(np.eye(4), (count, 1, 1))
    path[:, :3, :3] = Slerp(known, Rotation.from_matrix(world_from_cam[:, :3, :3]))(at).as_matrix()
    path[:, :3, 3] = np.stack([np.interp(at, known, world_from_cam[:, k, 3]) for k in range(3)], axis=1)
    return path


def smoothed(world_from_cam: Array, sigma: float) -> Array:
    """(N, 4, 4) the path without the tremble of the hand: Gaussian means over `sigma` frames."""
    quat_xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()
    # q and -q are one rotation; neighbours must have the same sign before they are averaged.
    flips = np.cumprod(np.concatenate([[1.0], np.where((quat_xyzw[1:] * quat_xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0)]))
    mean_quat = gaussian_filter1d(quat_xyzw * flips[:, None], sigma, axis=0, mode="nearest")
    path = world_from_cam.copy()
    path[:, :3, :3] = Rotation.from_quat(mean_quat).as_matrix()
    path[:, :3, 3] = gaussian_filter1d(world_from_cam[:, :3, 3], sigma, axis=0, mode="nearest")
    return path


def orbit(world_from_cam: Array, scene_depth: float, count: int, up: Array) -> Array:
    """(count, 4, 4) round the place the cameras look at, at their usual distance and height: once round where they
    stood on all sides of it, else back and forth over the arc from which they saw it.

    scene_depth: the usual distance of the scene, which stands in where the cameras do not look at one place; up (3,)
    unit vector in the world.
    """
    focus, radius, height = _focus(world_from_cam, up, scene_depth)
    first = _any_across(up)
    second = np.cross(up, first)
    away = world_from_cam[:, :3, 3] - focus
    start, arc = _arc(np.arctan2(away @ second, away @ first))
    share = np.arange(count) / count
    turns = share if arc >= _ALL_ROUND else (1 - np.cos(2 * np.pi * share)) / 2
    angle = start + (2 * np.pi if arc >= _ALL_ROUND else arc) * turns
    centers = focus + radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second) + height * up
    return _looking_at(centers, focus, up)


def _arc(angles: Array) -> tuple[float, float]:
    """Where the shortest arc around all of these angles begins, and its length, which is `_LEAST_ARC` at least."""
    angles = np.sort(np.mod(angles, 2 * np.pi))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    arc = float(2 * np.pi - gaps[widest])
    beyond = max(_LEAST_ARC - arc, 0) / 2
    return float(angles[(widest + 1) % len(angles)]) - beyond, arc + 2 * beyond


def around(middle: Array, size: float, up: Array, count: int) -> Array:
    """(count, 4, 4) once round a scene of which no camera is known, a little from above; `size` is its largest side."""
    first = _any_across(up)
    second = np.cross(up, first)
    angle = 2 * np.pi * np.arange(count) / count
    circle = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return _looking_at(middle + _FROM_OUTSIDE * size * (circle + 0.25 * up), middle, up)


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


def _any_across(up: Array) -> Array:
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return np.asarray(side / np.linalg.norm(side))


def _looking_at(centers: Array, target: Array, up: Array) -> Array:
    forward = target - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    path = np.tile(np.eye(4), (len(centers), 1, 1))
    path[:, :3, 0], path[:, :3, 1], path[:, :3, 2] = right, np.cross(forward, right), forward
    path[:, :3, 3] = centers
    return path
