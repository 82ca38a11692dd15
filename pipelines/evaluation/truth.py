"""Which truth belongs to which frame of a run, and errors of a trajectory against it: ATE and RPE."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.datasets import Dataset
from ...formats.errors import InputError
from ...formats.image_folder import frame_number
from ...formats.textfile import read_rows
from ...formats.trajectory import read_trajectory
from ..geometry import se3
from ..geometry.se3 import Similarity, align_points
from ..run.outcome import Outcome, spread_sample
from ..source.recording import written_name
from ..types import Array, Frame, require_shape

_MAX_SECONDS_APART = 0.02
_MIN_PAIRS = 3
_COMPARED, _THUMBNAIL, _ALIKE = 12, 32, 0.8
"""Pairs whose images are compared, as grey thumbnails of so many pixels a side, and the median correlation below which
they are not of the same instants. On four recordings the same image through another lens (k1 to -0.3) and JPEG has 0.85
to 0.997, images a third to half a second apart 0.25 to 0.7."""


@dataclass(frozen=True)
class MatchedTruth:
    """For N frames of a run: world_from_cam (N, 4, 4), NaN without; image (N,) index into the sequence, -1 without;
    `by`: how they were matched, in words."""

    sequence: Dataset
    world_from_cam: NDArray[np.float64]
    image: NDArray[np.int64]
    by: str

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))


def match_truth(
    frames: list[Frame],
    names_are_the_sources: bool,
    sequence: Dataset,
    image_of: Callable[[Frame], NDArray[np.uint8]] | None = None,
    is_timed: bool = True,
) -> MatchedTruth:
    """Match by file name where the frames kept their names and most are there; else by time; else, where the truth or
    the run (`is_timed`) has no times, by the name or number under which the images look the same.

    Times may differ by a constant: a video counts from its beginning, some data sets from 1970. Raises InputError where
    there are neither times nor such names, or no `image_of` (the frame's (H, W, 3) pixels) to compare.
    """
    index_of = {written_name(name): i for i, name in enumerate(sequence.names)}
    by_name = np.array([index_of.get(f.name, -1) for f in frames], np.int64)
    if names_are_the_sources and (by_name >= 0).mean() > 0.5:
        return _match_images(by_name, sequence, "file name")
    if is_timed and has_times(sequence):
        return match_by_time(np.array([f.timestamp for f in frames]), sequence)
    kinds = {"file name": by_name} | _by_numbers(frames, names_are_the_sources, sequence)
    kinds = {by: image for by, image in kinds.items() if (image >= 0).sum() >= min(_MIN_PAIRS, len(sequence))}
    alike = {by: _likeness(frames, image, sequence, image_of) for by, image in kinds.items()} if image_of else {}
    best = max(alike, key=alike.__getitem__, default="")
    if alike.get(best, 0.0) < _ALIKE:
        without = "its images have no times" if is_timed else "the images of the run have no times"
        raise InputError(
            f"{sequence.root}: {without}, and neither the names nor the numbers of its images ({len(sequence)}, "
            f"{sequence.names[0]} first) lead to images of the run ({frames[0].name} first) that look the same. "
            + ("Add timestamps.txt with the seconds of each image, or name" if is_timed else "Name")
            + " the images as the run's are"
        )
    return _match_images(kinds[best], sequence, best)


def match_outcome(outcome: Outcome, sequence: Dataset) -> MatchedTruth:
    """Match the frames of a run, see `match_truth`."""
    return match_truth(outcome.frames, outcome.source_is_folder, sequence, outcome.run.image, outcome.is_timed)


def _match_images(image: NDArray[np.int64], sequence: Dataset, by: str) -> MatchedTruth:
    poses = np.full((len(image), 4, 4), np.nan)
    if sequence.world_from_cam is not None:
        poses[image >= 0] = sequence.world_from_cam[image[image >= 0]]
    return MatchedTruth(sequence, poses, image, by)


def _by_numbers(frames: list[Frame], names_are_the_sources: bool, sequence: Dataset) -> dict[str, NDArray[np.int64]]:
    """Images by the number in their name: that in the frame's name, or a video's frame, counted from 0 or 1."""
    index_of = {frame_number(Path(name)): i for i, name in enumerate(sequence.names)}
    if len(index_of) < len(sequence) or None in index_of:
        return {}
    if names_are_the_sources:
        numbers: dict[str, list[int | None]] = {"frame number": [frame_number(Path(f.name)) for f in frames]}
    else:
        numbers = {
            "frame number": [f.source_index for f in frames],
            "frame number, counted from 1": [f.source_index + 1 for f in frames],
        }
    return {by: np.array([index_of.get(n, -1) for n in found], np.int64) for by, found in numbers.items()}


def _likeness(
    frames: list[Frame], image: NDArray[np.int64], sequence: Dataset, image_of: Callable[[Frame], NDArray[np.uint8]]
) -> float:
    """Median correlation of grey thumbnails of matched images."""

    def thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
        small = cv2.resize(rgb, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA).astype(np.float64).mean(axis=2)
        return (small - small.mean()) / max(float(small.std()), 1e-6)

    rows = spread_sample(np.flatnonzero(image >= 0).tolist(), _COMPARED)
    pairs = [(thumbnail(image_of(frames[r])), thumbnail(sequence.rgb(int(image[r])))) for r in rows]
    return float(np.median([(a * b).mean() for a, b in pairs]))


def has_times(sequence: Dataset) -> bool:
    """Whether images or poses of the truth have times."""
    return sequence.timestamps is not None or _dense_trajectory(sequence.root) is not None


def match_by_time(times: NDArray[np.float64], sequence: Dataset) -> MatchedTruth:
    """Match the instants (N,) in seconds, which may differ from the sequence's by a constant; `has_times` of it."""
    pose_times, true_poses = true_trajectory(sequence)
    image_times = np.zeros(0) if sequence.timestamps is None else sequence.timestamps
    first = float(min((t[0] for t in (image_times, pose_times) if len(t)), default=0.0))
    start = first if first > times[-1] + 1 else 0.0
    image = np.full(len(times), -1, np.int64)
    i, j = associate(times, image_times - start, _tolerance(image_times))
    image[i] = j
    poses = np.full((len(times), 4, 4), np.nan)
    i, j = associate(times, pose_times - start, _tolerance(pose_times))
    poses[i] = true_poses[j]
    by = "time" if start == 0 else f"time, truth shifted by {-start:.3f} s"
    return MatchedTruth(sequence, poses, image, by)


def _tolerance(times: NDArray[np.float64]) -> float:
    """A third of the usual gap: a frame between two truths belongs to neither."""
    return min(_MAX_SECONDS_APART, float(np.median(np.diff(times))) / 3) if len(times) > 1 else _MAX_SECONDS_APART


def true_trajectory(sequence: Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N,) times and (N, 4, 4) world_from_cam: of the images, or of a traj.txt that is denser than the images.

    A recording may keep all its poses and times and only every k-th image.
    """
    dense = _dense_trajectory(sequence.root)
    if dense is not None and (sequence.timestamps is None or len(dense[0]) > len(sequence)):
        return dense
    if sequence.world_from_cam is None or sequence.timestamps is None:
        return np.zeros(0), np.zeros((0, 4, 4))
    known = sequence.has_pose
    return sequence.timestamps[known], sequence.world_from_cam[known]


def _dense_trajectory(root: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Times and poses of traj.txt: of its TUM lines, or of its matrices at the times in timestamps.txt."""
    poses_file, times_file = root / "traj.txt", root / "timestamps.txt"
    if not poses_file.is_file():
        return None
    found = read_trajectory(poses_file)
    poses = found.world_from_cam
    if found.times is not None:
        return found.times, poses
    if not times_file.is_file():
        return None
    rows = read_rows(times_file)
    if len(rows) != len(poses) or any(len(r) != 1 for r in rows):
        return None
    known = np.isfinite(poses).all(axis=(1, 2))
    times = np.array([float(r[0]) for r in rows])
    return times[known], poses[known]


@dataclass(frozen=True)
class ErrorStatistics:
    """Root mean square, mean, median and maximum of errors of one unit."""

    rmse: float
    mean: float
    median: float
    max: float

    @staticmethod
    def of(errors: NDArray) -> ErrorStatistics:
        """Summarise (N,) errors. Raises ValueError for N = 0."""
        if len(errors) == 0:
            raise ValueError("no errors to summarise")
        return ErrorStatistics(
            float(np.sqrt((errors**2).mean())), float(errors.mean()), float(np.median(errors)), float(errors.max())
        )


@dataclass(frozen=True)
class AbsoluteError:
    """errors (N,) between aligned estimate and truth in the truth's unit, and truth_from_estimate."""

    errors: Array
    alignment: Similarity

    @property
    def statistics(self) -> ErrorStatistics:
        return ErrorStatistics.of(self.errors)


def associate(times: Array, truth_times: Array, tolerance: float = 0.01) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (i, j) of estimates and truths that are each other's nearest, within `tolerance` seconds; the lists may
    have any order and gaps."""
    if len(times) == 0 or len(truth_times) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    times, truth_times = (np.nan_to_num(t[:, None], nan=far) for t, far in ((times, -1e18), (truth_times, 1e18)))
    gaps, nearest = cKDTree(truth_times).query(times)
    back = cKDTree(times).query(truth_times)[1]
    i = np.flatnonzero((gaps <= tolerance) & (back[nearest] == np.arange(len(times))))
    return i, nearest[i]


def absolute_error(centers: Array, true_centers: Array, with_scale: bool) -> AbsoluteError:
    """ATE: distances of camera centres (N, 3) from the true ones after the best Sim(3), or SE(3) without scale.

    Raises ValueError where the alignment is not determined (fewer than three, or on one line).
    """
    alignment = align_points(centers, true_centers, with_scale)
    return AbsoluteError(np.linalg.norm(alignment.apply(centers) - true_centers, axis=1), alignment)


@dataclass(frozen=True)
class RelativeError:
    """translation (N - delta,) in the truth's unit, rotation (N - delta,) degrees of the motion over `delta` frames."""

    translation: Array
    rotation: Array


def relative_error(
    world_from_cam: Array, true_world_from_cam: Array, delta: int = 1, scale: float = 1.0
) -> RelativeError:
    """RPE (Sturm et al., IROS 2012): the motion from frame i to i + delta against the true one, for every i.

    Both (N, 4, 4); `scale` multiplies the estimate's translations. Raises ValueError for N <= delta.
    """
    require_shape("true_world_from_cam", true_world_from_cam, world_from_cam.shape)
    if len(world_from_cam) <= delta:
        raise ValueError(f"got {len(world_from_cam)} poses, a motion over {delta} frames needs more")
    scaled = world_from_cam.copy()
    scaled[:, :3, 3] *= scale
    motion, truth = (np.linalg.inv(p[:-delta]) @ p[delta:] for p in (scaled, true_world_from_cam))
    difference = np.linalg.inv(truth) @ motion
    return RelativeError(np.linalg.norm(difference[:, :3, 3], axis=1), np.degrees(se3.rotation_angle(difference)))
