"""Poses and calibration as the user gives them, and which pose belongs to which frame."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets.calibration import HOW_INTRINSICS, camera_from_numbers, read_calibration_file
from ...formats.datasets.folder import SAME_INSTANT_SECONDS, poses_at
from ...formats.datasets.sequence import Camera
from ...formats.errors import InputError
from ...formats.image_folder import frame_number, match_names, stem
from ...formats.poses import read_poses
from ...formats.reading import home_expanded, reaching
from ...formats.textfile import is_number
from ...formats.trajectory import PoseFile
from ..config import FramesConfig
from ..types import Frame, GivenPoses
from .files import Warn
from .recording import Recording, VideoRecording

_MAX_NAMED = 8

_MAX_STEP = 60
MIN_POSES = 3
"""Poses that belong to an image, below which a file is taken for one of another recording."""


def given_poses(
    config: FramesConfig, source: Recording, frames: Sequence[Frame], warn: Warn | None = None
) -> GivenPoses | None:
    """The poses of `frames.poses` frame by frame; None where none are given.

    An image's pose is known by its name; of a file of times by the nearest within 20 ms; of one that states
    neither, or times of images without, by the order, where there are as many as images. Poses of the file that are not
    finite are reported to `warn`. Raises InputError where fewer than three belong to a frame.
    """
    if not config.poses:
        return None
    from ..geometry import se3  # imports torch

    file = read_poses(Path(config.poses))
    if file.names:
        found = _by_name(file, source, frames, config.poses)
    elif file.times is not None and source.is_timed():
        found = poses_at(np.array([f.timestamp for f in frames]), file.times, file.world_from_cam, SAME_INSTANT_SECONDS)
    else:
        found = _by_order(file, source, frames, config.poses)
    known = np.isfinite(found).all(axis=(1, 2))
    if known.sum() < min(MIN_POSES, len(frames)):
        raise InputError(
            f"--poses {config.poses}: of its {len(file)} poses {known.sum()} belong to frames of {source.path}"
            f"{_examples(file, frames)}. Give the poses of these images"
        )
    if file.lost and warn is not None:
        warn(f"--poses {config.poses}: {file.lost} of its poses are not finite, as lost tracking is written: left out")
    cam_from_world = np.full_like(found, np.nan)
    cam_from_world[known] = se3.inverse(found[known])
    return GivenPoses(cam_from_world, file.is_metric, file.kind)


def numbering(config: FramesConfig, frames: Sequence[Frame], fits: Callable[[NDArray[np.float64]], bool]) -> str:
    """Say under which other numbering the poses of `frames.poses` are those of the frames; "" where none is found.

    Tried are the numbers, in the file's names or of its rows, as those of every n-th image counted from 0 or 1. `fits`
    says whether (N, 4, 4) cam_from_world, NaN for a frame without, are the frames'.
    """
    from ..geometry import se3

    file = read_poses(Path(config.poses))
    if file.times is not None and not file.names:
        return ""
    row_of = {frame_number(Path(name.replace(".", "_"))): k for k, name in enumerate(file.names)}
    row_of = row_of or {k: k for k in range(len(file))}
    for first, step in itertools.product((1, 0), range(1, _MAX_STEP + 1)):
        found = _rows(file, [row_of.get(round(f.source_index / step) + first) for f in frames])
        if fits(se3.inverse(found)):
            every = "image" if step == 1 else f"{step}th image" if step > 3 else {2: "2nd image", 3: "3rd image"}[step]
            return f"every {every}, counted from {first}"
    return ""


def check_poses(config: FramesConfig, source: Recording) -> None:
    """Raise InputError for poses that cannot belong to the source, as far as its names and their number show."""
    if not config.poses:
        return
    file = read_poses(Path(config.poses))
    pictures = [Frame(i, source.name(i, i), 0.0, i, 0.0) for i in range(source.expected_frames)]
    if file.names or file.times is None or not source.is_timed():
        given_poses(config, source, pictures)


def _by_name(file: PoseFile, source: Recording, frames: Sequence[Frame], path: str) -> NDArray[np.float64]:
    """A video's frames are called by their numbers."""
    if isinstance(source, VideoRecording):
        numbers = [frame_number(Path(stem(n).replace(".", "_"))) for n in file.names]
        twice = next((n for n, count in Counter(numbers).items() if n is not None and count > 1), None)
        if twice is not None:
            raise InputError(f"--poses {path}: two poses are of images with the number {twice}: names must differ")
        row_of = {n: k for k, n in enumerate(numbers)}
        return _rows(file, [row_of.get(f.source_index) for f in frames])
    return _rows(file, match_names([source.place(f.source_index) for f in frames], file.names))


def _by_order(file: PoseFile, source: Recording, frames: Sequence[Frame], path: str) -> NDArray[np.float64]:
    if source.expected_frames != len(file):
        raise InputError(
            f"--poses {path}: {len(file)} poses for {source.expected_frames} images, and neither names nor times "
            "tell which belongs to which: give one for each image, or poses with the images' names"
        )
    return _rows(file, [f.source_index for f in frames])


def _rows(file: PoseFile, rows: Sequence[int | None]) -> NDArray[np.float64]:
    found = np.full((len(rows), 4, 4), np.nan)
    for k, row in enumerate(rows):
        if row is not None:
            found[k] = file.world_from_cam[row]
    return found


def _examples(file: PoseFile, frames: Sequence[Frame]) -> str:
    if file.names:
        return f" (its first is of {file.names[0]!r}, the source's first image is {frames[0].name!r})"
    if file.times is None:
        return ""
    return f" (it begins at {file.times[0]:.2f} s, the source at {frames[0].timestamp:.2f} s)"


def read_intrinsics(text: str, width: int, height: int) -> Camera:
    """The camera of a width x height source from `frames.intrinsics`.

    `text` is `fx,fy,cx,cy[,k1,k2,p1,p2]` or the name of a file that `read_calibration_file` reads; `FILE#NAME` is one
    of its cameras. Numbers, and files that say nothing else, have COLMAP's convention, the centre of the first pixel at
    (0.5, 0.5); OpenCV, ROS and their kin count from (0, 0), which is settled here. Raises InputError where it is none
    of these, cannot belong to the source, or is one of several.
    """
    words = text.replace(",", " ").split()
    if words and all(map(is_number, words)):
        return camera_from_numbers([float(word) for word in words], (width, height), f"intrinsics {text}")
    path, name = Path(text), ""
    with reaching(path):
        path = home_expanded(path)
        if not path.is_file() and "#" in text:
            beginning, _, name = text.rpartition("#")
            path = home_expanded(beginning)
        if not path.is_file():
            raise InputError(f"intrinsics {text!r} are neither numbers nor an existing file: {HOW_INTRINSICS}")
    camera = _one_of(read_calibration_file(path, (width, height)), name, path)
    try:
        return camera.resized(width, height)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _one_of(cameras: dict[str, Camera], name: str, path: Path) -> Camera:
    """The camera of a name, or the only one. Raises InputError where several differ and none is named."""
    if name in cameras:
        return cameras[name]
    if len(set(cameras.values())) == 1 and not name:
        return next(iter(cameras.values()))
    known = [f"{n} ({c.width}x{c.height}, fx {c.fx:.6g})" for n, c in cameras.items()]
    shown = ", ".join(known[:_MAX_NAMED]) + (", ..." if len(known) > _MAX_NAMED else "")
    found = f"no camera {name!r} but" if name else f"{len(known)} cameras that differ:"
    raise InputError(
        f"{path} holds {found} {shown}: name the one that took the images, --intrinsics '{path}#{next(iter(cameras))}'"
    )
