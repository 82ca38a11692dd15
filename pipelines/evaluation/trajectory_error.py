"""Errors of a trajectory: absolute (ATE) and relative (RPE), on camera centres and poses of the same instants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..geometry.se3 import Similarity, align_points
from ..types import Array, require_shape


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
    """errors (N,) metres between aligned estimate and truth, and truth_from_estimate."""

    errors: Array
    alignment: Similarity

    @property
    def statistics(self) -> ErrorStatistics:
        return ErrorStatistics.of(self.errors)


def associate(times: Array, truth_times: Array, tolerance: float = 0.01) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (i, j) of estimates and truths of the same instant, within `tolerance` seconds; each used at most once.

    The nearest pairs are taken first. Both lists may have any order and gaps.
    """
    if len(times) == 0 or len(truth_times) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = np.argsort(truth_times, kind="stable")
    after = np.clip(np.searchsorted(truth_times[order], times), 0, len(order) - 1)
    before = np.maximum(after - 1, 0)
    gap_before, gap_after = (np.abs(truth_times[order[k]] - times) for k in (before, after))
    nearest = np.where(gap_before < gap_after, order[before], order[after])
    gaps = np.minimum(gap_before, gap_after)
    taken: set[int] = set()
    pairs = []
    for i in np.argsort(gaps, kind="stable"):
        if gaps[i] <= tolerance and int(nearest[i]) not in taken:
            taken.add(int(nearest[i]))
            pairs.append((int(i), int(nearest[i])))
    matched = np.array(sorted(pairs), np.int64).reshape(-1, 2)
    return matched[:, 0], matched[:, 1]


def absolute_error(centers: Array, true_centers: Array, with_scale: bool) -> AbsoluteError:
    """ATE: distances of camera centres (N, 3) from the true ones after the best Sim(3), or SE(3) without scale.

    Raises ValueError where the alignment is not determined (fewer than three, or on one line).
    """
    alignment = align_points(centers, true_centers, with_scale)
    return AbsoluteError(np.linalg.norm(alignment.apply(centers) - true_centers, axis=1), alignment)


@dataclass(frozen=True)
class RelativeError:
    """translation (N - delta,) metres and rotation (N - delta,) degrees of the motion over `delta` frames."""

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
