"""What all frames say of the class of a place in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.camera import unproject_depth
from pipelines.proxy.providers import DepthEstimate, LabelEstimate
from pipelines.proxy.regions.voxels import find, voxel_keys
from pipelines.proxy.sequence import Sequence, resample_nearest
from pipelines.types import VOID, Frame

_VOXELS_PER_DEPTH = 50
_SIDE = 160
_LEAST_CONFIDENCE = 0.3
_STRENGTH = 1.5
"""How much a unanimous place counts against the frame's own probability."""


@dataclass(frozen=True)
class WorldVotes:
    """keys (V,) of voxels, share (V, C) of each class in the votes for them."""

    sequence: Sequence
    size: float
    keys: NDArray[np.int64]
    share: NDArray[np.float32]

    @staticmethod
    def gather(
        sequence: Sequence,
        frames: list[Frame],
        depth_of: Callable[[Frame], DepthEstimate],
        labels_of: Callable[[Frame], LabelEstimate],
        classes: int,
    ) -> WorldVotes | None:
        """Votes of the frames that have poses; None when there are too few of them."""
        posed = [f for f in frames if f.id in sequence.cam_from_world]
        size = _voxel_size(sequence, [depth_of(f) for f in posed[:: max(1, len(posed) // 10)]])
        if len(posed) < 2 or size <= 0:
            return None
        joint = np.empty(0, np.int64)
        weights: NDArray[np.float64] = np.empty(0)
        for frame in posed:
            keys, labels, weight = _ballots(sequence, frame, depth_of(frame), labels_of(frame), size)
            # Voxel and class in one number would overflow; rank the voxels of the running total instead.
            known, place = np.unique(np.concatenate([joint.reshape(-1, 2)[:, 0], keys]), return_inverse=True)
            label = np.concatenate([joint.reshape(-1, 2)[:, 1], labels])
            sums = np.bincount(place * classes + label, np.concatenate([weights, weight]), len(known) * classes)
            cells = np.flatnonzero(sums)
            joint = np.stack([known[cells // classes], cells % classes], axis=1).ravel()
            weights = sums[cells].astype(np.float64)
        table = joint.reshape(-1, 2)
        keys, place = np.unique(table[:, 0], return_inverse=True)
        share = np.zeros((len(keys), classes), np.float32)
        share[place, table[:, 1]] = weights
        # One frame's worth of doubt: a place seen once does not outvote what is seen now.
        share /= share.sum(1, keepdims=True) + 1.0
        return WorldVotes(sequence, size, keys, share)

    def combine(self, frame: Frame, depth: DepthEstimate, own: LabelEstimate) -> LabelEstimate:
        """The frame's labels (h, w) corrected by the votes for the places its pixels show."""
        if frame.id not in self.sequence.cam_from_world:
            return own
        at = find(self.keys, _keys(self.sequence, frame, depth.depth, self.size))
        known = (at >= 0) & (depth.confidence >= _LEAST_CONFIDENCE)
        total = np.zeros((*own.labels.shape, self.share.shape[1]), np.float32)
        total[known] = _STRENGTH * self.share[at[known]]
        rows, columns = np.nonzero(own.labels != VOID)
        total[rows, columns, own.labels[rows, columns]] += own.confidence[rows, columns]
        best = total.argmax(-1).astype(np.uint8)
        strength = total.max(-1)
        best[strength <= 0] = VOID
        confidence = np.where(known, strength / (1 + _STRENGTH), strength)
        return LabelEstimate(best, np.clip(confidence, 0, 1).astype(np.float32), own.descriptor)


def _voxel_size(sequence: Sequence, estimates: list[DepthEstimate]) -> float:
    known = [e.depth[(e.depth > 0) & (e.confidence >= _LEAST_CONFIDENCE)][::7] for e in estimates]
    depths = np.concatenate([np.empty(0), *known])
    return float(np.median(depths)) / _VOXELS_PER_DEPTH if len(depths) else 0.0


def _keys(sequence: Sequence, frame: Frame, depth: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    camera = sequence.intrinsics.resized(depth.shape[1], depth.shape[0])
    world_from_cam = np.linalg.inv(sequence.cam_from_world[frame.id])
    points = unproject_depth(depth, camera) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    return np.where(depth > 0, voxel_keys(points, size), -1)


def _ballots(
    sequence: Sequence, frame: Frame, depth: DepthEstimate, labels: LabelEstimate, size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """One frame's votes: voxel keys, labels and weights; every voxel has one vote to share out."""
    height, width = labels.labels.shape
    scale = min(1.0, _SIDE / max(height, width))
    rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
    label = resample_nearest(labels.labels, rows, columns)
    keys = _keys(sequence, frame, resample_nearest(depth.depth, rows, columns), size)
    confidence = resample_nearest(depth.confidence, rows, columns)
    use = (label != VOID) & (keys >= 0) & (confidence >= _LEAST_CONFIDENCE)
    weight = resample_nearest(labels.confidence, rows, columns)[use].astype(np.float64)
    key = keys[use]
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    return key, label[use].astype(np.int64), weight / count[place]
