"""Which given pose belongs to which frame."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets.matching import SAME_INSTANT_SECONDS, poses_at
from ...formats.errors import InputError
from ...formats.image_folder import frame_number
from ...formats.poses import PoseFile, read_poses, stem
from ...formats.reading import files_sha256, home_expanded
from ..config import FramesConfig
from ..geometry import se3
from ..types import Frame, GivenPoses
from .opening import FolderSource, VideoSource, Warn
from .recording import RecordingSource

AnySource = VideoSource | FolderSource | RecordingSource
LEAST = 3
"""Poses that belong to an image, below which a file is taken for one of another recording."""


def given_poses(
    config: FramesConfig, source: AnySource, frames: Sequence[Frame], warn: Warn | None = None
) -> GivenPoses | None:
    """The poses of `frames.poses` frame by frame; None where none are given.

    An image's pose is known by its name; of a file of times by the nearest within 20 ms; of one that states
    neither, or times of images without, by the order, where there are as many as images. Poses of the file that are not
    finite are reported to `warn`. Raises InputError where fewer than three belong to a frame.
    """
    if not config.poses:
        return None
    file = read_poses(Path(config.poses))
    if file.names:
        found = _by_name(file, source, frames)
    elif file.times is not None and source.has_times:
        found = poses_at(np.array([f.timestamp for f in frames]), file.times, file.world_from_cam, SAME_INSTANT_SECONDS)
    else:
        found = _by_order(file, source, frames, config.poses)
    known = np.isfinite(found).all(axis=(1, 2))
    if known.sum() < min(LEAST, len(frames)):
        raise InputError(
            f"--poses {config.poses}: of its {len(file)} poses {known.sum()} belong to frames of {source.path}"
            f"{_examples(file, frames)}. Give the poses of these images"
        )
    if file.lost and warn is not None:
        warn(f"--poses {config.poses}: {file.lost} of its poses are not finite, as lost tracking is written: left out")
    cam_from_world = np.full_like(found, np.nan)
    cam_from_world[known] = se3.inverse(found[known])
    return GivenPoses(cam_from_world, file.is_metric, file.kind)


def check_poses(config: FramesConfig, source: AnySource) -> None:
    """Raise InputError for poses that cannot belong to the source, as far as its names and their number show."""
    if not config.poses:
        return
    file = read_poses(Path(config.poses))
    pictures = [Frame(i, source.name(i, i), 0.0, i, 0.0) for i in range(source.expected_frames)]
    if file.names or file.times is None or not source.has_times:
        given_poses(config, source, pictures)


def pose_inputs(config: FramesConfig) -> dict[str, str]:
    """Return the digest of the pose files; {} where none are given. Raises InputError where they are gone."""
    if not config.poses:
        return {}
    path = home_expanded(config.poses)
    if not path.exists():
        raise InputError(f"--poses {path}: there is no such file or folder: check the spelling")
    files = sorted(p for p in path.rglob("*") if p.suffix in (".bin", ".txt", ".json")) if path.is_dir() else [path]
    return {"poses": files_sha256((p.name, p) for p in files)}


def _by_name(file: PoseFile, source: AnySource, frames: Sequence[Frame]) -> NDArray[np.float64]:
    """A video's frames are called by their numbers."""
    if isinstance(source, VideoSource):
        rows = {frame_number(Path(n.replace(".", "_"))): k for k, n in enumerate(file.names)}
        return _rows(file, [rows.get(f.source_index) for f in frames])
    named = {n: k for k, n in enumerate(file.names)}
    return _rows(file, [named.get(stem(source.name(f.id, f.source_index))) for f in frames])


def _by_order(file: PoseFile, source: AnySource, frames: Sequence[Frame], path: str) -> NDArray[np.float64]:
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
        return f" (its first is of {file.names[0]!r}, the source's first image is {stem(frames[0].name)!r})"
    if file.times is None:
        return ""
    return f" (it begins at {file.times[0]:.2f} s, the source at {frames[0].timestamp:.2f} s)"
