"""Scale along the path: the depth of one surface by the views before a keyframe, and by those after it.

Two views agree by their epipolar lines whatever the length between them, so no pair of views contradicts a path whose
unit grows along the way. Three do: what a keyframe shows has one depth by the views before it and another by those
after it.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from .matching import VerifiedPair

Array = NDArray[np.float64]

_MIN_ANGLE = np.radians(1.0)
"""Rays that are nearer to parallel give no depth."""
_MIN_FEATURES = 12
_MAX_ERROR = 2.0
"""Pixels from the epipolar line."""
_SURE = 3.0
"""Standard deviations that are taken off the drift."""
MAX_DRIFT = 1.25
"""A path is consistent up to this."""


@dataclass(frozen=True)
class ScaleDrift:
    """By what factor the unit of a path differs at least between two keyframes, `first` and `last`; 1 for a path of one
    scale."""

    factor: float = 1.0
    first: int = 0
    last: int = 0


NO_DRIFT = ScaleDrift()


def scale_drift(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[Array], total: int, reach: int
) -> ScaleDrift:
    """Measure how the scale of a path changes, by matches of keyframes at most `reach` apart; other arguments as of
    `consistency.judge`. Of panoramas the first direction is measured."""
    camera, focal = model.cameras[1], model.cameras[1].mean_focal_length()
    placed = [i - 1 for i in sorted(model.reg_image_ids()) if i <= total]
    poses = {k: model.images[k + 1].cam_from_world().matrix() for k in placed}
    rays = {k: _unit_rays(camera, xy[k]) for k in placed}
    sides: dict[int, tuple[_Side, _Side]] = defaultdict(lambda: (_Side(), _Side()))
    for pair in pairs:
        i, j = sorted((pair.first, pair.second))
        if i not in poses or j not in poses or not 0 < j - i <= reach:
            continue
        matches = pair.matches if pair.first == i else pair.matches[:, ::-1]
        seen = rays[i][matches[:, 0]], rays[j][matches[:, 1]]
        depth_i, depth_j, angle, off = _depths(poses[i], poses[j], *seen)
        good = (angle > _MIN_ANGLE) & (off * focal < _MAX_ERROR) & (depth_i > 0) & (depth_j > 0)
        sides[i][1].add(matches[good, 0], depth_i[good], angle[good], j - i)
        sides[j][0].add(matches[good, 1], depth_j[good], angle[good], j - i)
    steps, variances = np.zeros(total), np.zeros(total)
    for k, (before, after) in sides.items():
        steps[k], variances[k] = _growth(before, after, len(xy[k]))
    along = np.concatenate([[0.0], np.cumsum(steps)])
    doubt = np.concatenate([[0.0], np.cumsum(variances)])
    apart = np.abs(along[:, None] - along[None]) - _SURE * np.sqrt(np.abs(doubt[:, None] - doubt[None]) * 2 * reach)
    first, last = sorted(np.unravel_index(int(np.argmax(apart)), apart.shape))
    if not apart[first, last] > 0:
        return NO_DRIFT
    return ScaleDrift(float(np.exp(apart[first, last])), int(first), int(last) - 1)


class _Side:
    """Depths of a keyframe's features by views on one side of it."""

    def __init__(self) -> None:
        self.features: list[NDArray[np.int64]] = []
        self.rows: list[Array] = []

    def add(self, features: NDArray[np.uint32], depth: Array, angle: Array, apart: int) -> None:
        self.features.append(features.astype(np.int64))
        self.rows.append(np.column_stack([angle**2, np.log(depth) * angle**2, np.full(len(depth), apart) * angle**2]))

    def mean(self, count: int) -> Array:
        """(count, 3) of every feature the sum of the weights, and weighted means of log depth and of the distance."""
        sums = np.zeros((count, 3))
        for features, rows in zip(self.features, self.rows, strict=True):
            np.add.at(sums, features, rows)
        sums[:, 1:] /= np.maximum(sums[:, :1], 1e-12)
        return sums


def _growth(before: _Side, after: _Side, count: int) -> tuple[float, float]:
    """By how much the logarithm of the unit grows from a keyframe to the next, and its variance."""
    a, b = before.mean(count), after.mean(count)
    both = (a[:, 0] > 0) & (b[:, 0] > 0)
    if both.sum() < _MIN_FEATURES:
        return 0.0, 0.0
    # A depth by a view twice as far along the path is off by half of what has grown on the way.
    span = (a[both, 2] + b[both, 2]) / 2
    growth = (b[both, 1] - a[both, 1]) / span
    middle = float(np.median(growth))
    spread = 1.4826 * float(np.median(np.abs(growth - middle)))
    return middle, 1.57 * spread**2 / both.sum()


def _unit_rays(camera: pycolmap.Camera, xy: Array) -> Array:
    rays = np.column_stack([np.asarray(camera.cam_from_img(xy)), np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _depths(first: Array, second: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """Distances (M,) along unit rays a and b (M, 3) of two cameras to where they are nearest to each other, the angle
    between them, and the angle by which they miss each other."""
    rotation = second[:, :3] @ first[:, :3].T
    move = second[:, 3] - rotation @ first[:, 3]  # where the first centre lies in the second camera
    turned = a @ rotation.T
    cosine = (turned * b).sum(1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_a, along_b = turned @ move, b @ move
    depth_a = (cosine * along_b - along_a) / sine2
    depth_b = (along_b - cosine * along_a) / sine2
    gap = np.linalg.norm(move + depth_a[:, None] * turned - depth_b[:, None] * b, axis=1)
    return (
        depth_a,
        depth_b,
        np.arcsin(np.minimum(np.sqrt(sine2), 1.0)),
        gap / np.maximum(np.minimum(depth_a, depth_b), 1e-9),
    )
