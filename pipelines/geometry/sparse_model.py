"""Posed keyframes and their points, as structure from motion leaves them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..types import require_shape, rows_by

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

    from .se3 import Similarity


@dataclass(frozen=True)
class SparseModel:
    """Keyframe poses and triangulated points of structure from motion, in the run's world.

    frame_ids (N,) int, cam_from_world (N, 4, 4) float64, points_in_world (P, 3) float64, colors (P, 3) uint8,
    and the observations: obs_frame (O,) int index into frame_ids, obs_point (O,) int index into points,
    obs_xy (O, 2) float64 pixels of the undistorted frame.
    """

    frame_ids: NDArray[np.int64]
    cam_from_world: NDArray[np.float64]
    points_in_world: NDArray[np.float64]
    colors: NDArray[np.uint8]
    obs_frame: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: NDArray[np.float64]

    def __post_init__(self) -> None:
        n, p, o = len(self.frame_ids), len(self.points_in_world), len(self.obs_frame)
        require_shape("cam_from_world", self.cam_from_world, (n, 4, 4))
        require_shape("points_in_world", self.points_in_world, (p, 3))
        require_shape("colors", self.colors, (p, 3))
        require_shape("obs_point", self.obs_point, (o,))
        require_shape("obs_xy", self.obs_xy, (o, 2))

    def moved(self, other_from_world: Similarity) -> SparseModel:
        """Transform cameras and points into another world."""
        poses = other_from_world.apply_to_poses(self.cam_from_world)
        return replace(self, cam_from_world=poses, points_in_world=other_from_world.apply(self.points_in_world))

    @cached_property
    def centers(self) -> NDArray[np.float64]:
        """(N, 3) of the cameras in the world."""
        return np.asarray(np.linalg.inv(self.cam_from_world)[:, :3, 3], np.float64).reshape(-1, 3)

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree over `centers`."""
        from scipy.spatial import cKDTree

        return cKDTree(self.centers)

    @cached_property
    def _rows(self) -> list[NDArray[np.int64]]:
        return rows_by(self.obs_frame, len(self.frame_ids))

    def observations_of(self, index: int) -> NDArray[np.int64]:
        """Rows of the observations that the keyframe made, in order."""
        return self._rows[index]

    @cached_property
    def seen(self) -> csr_matrix:
        """(N, P) bool: which keyframe observes which point."""
        from scipy.sparse import csr_matrix

        shape = len(self.frame_ids), len(self.points_in_world)
        return csr_matrix((np.ones(len(self.obs_frame), bool), (self.obs_frame, self.obs_point)), shape)

    @cached_property
    def seen_by(self) -> csr_matrix:
        """(P, N) bool: the same by point."""
        return self.seen.T.tocsr()

    def points_of(self, index: int) -> NDArray[np.int64]:
        """Sorted indices of the points that the keyframe observes."""
        return self.seen.indices[self.seen.indptr[index] : self.seen.indptr[index + 1]].astype(np.int64)
