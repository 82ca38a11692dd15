"""Least-squares alignment of point sets: rigid, or with a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import require_shape

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """target = scale * rotation @ source + translation; rotation (3, 3) in SO(3), translation (3,)."""

    scale: float
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        require_shape("rotation", self.rotation, (3, 3))
        require_shape("translation", self.translation, (3,))
        if not self.scale > 0:
            raise ValueError(f"scale must be positive, got {self.scale}")

    def apply(self, points: NDArray) -> Array:
        """(..., 3) source points in the target's frame."""
        return self.scale * (points @ self.rotation.T) + self.translation

    def apply_to_poses(self, cam_from_source: NDArray) -> Array:
        """cam_from_target (N, 4, 4): the same cameras, rigid, after their world was mapped into the target's."""
        cam_from_target = np.tile(np.eye(4), (len(cam_from_source), 1, 1))
        rotations = cam_from_source[:, :3, :3] @ self.rotation.T
        cam_from_target[:, :3, :3] = rotations
        cam_from_target[:, :3, 3] = self.scale * cam_from_source[:, :3, 3] - rotations @ self.translation
        return cam_from_target

    def inverse(self) -> Similarity:
        """Return the inverse transform, source_from_target."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        """a_from_b @ b_from_c = a_from_c."""
        translation = self.apply(other.translation)
        return Similarity(self.scale * other.scale, self.rotation @ other.rotation, translation)


def align_points(source: NDArray, target: NDArray, with_scale: bool = True) -> Similarity:
    """The similarity (or, without scale, the rigid motion) that takes source (N, 3) to target (N, 3).

    Least squares in closed form (Umeyama, PAMI 1991). Raises ValueError for fewer than three points, points
    that are not finite, or points on one line, where the rotation is not determined.
    """
    require_shape("source", source, (None, 3))
    require_shape("target", target, (len(source), 3))
    if len(source) < 3 or not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError(f"alignment needs at least three finite points, got {len(source)}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_centred, target_centred = source - source_mean, target - target_mean
    u, d, vt = np.linalg.svd(target_centred.T @ source_centred / len(source))
    if d[1] <= 1e-12 * max(d[0], 1e-300):
        raise ValueError("alignment is not determined: the points lie on one line")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float(d @ signs / (source_centred**2).sum(1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def best_rotation(source: Array, target: Array) -> Array:
    """(3, 3) in SO(3) that takes the directions source (N, 3) nearest to target (N, 3) (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(target.T @ source)
    return np.asarray((u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt, np.float64)
