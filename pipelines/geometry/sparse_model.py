"""Posed keyframes and their points, as structure from motion leaves them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics, require_shape, rows_by
from .camera import project

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


@dataclass(frozen=True)
class FrameObservations:
    """Observations of the points of a sparse model by frames that are no keyframes.

    frame_id (O,) int, obs_point (O,) int index into the points, obs_xy (O, 2) float32 pixels of the undistorted frame.
    """

    frame_id: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: NDArray[np.float32]

    def __post_init__(self) -> None:
        require_shape("obs_point", self.obs_point, (len(self.frame_id),))
        require_shape("obs_xy", self.obs_xy, (len(self.frame_id), 2))

    def carried(self, old: SparseModel, new: SparseModel) -> FrameObservations:
        """Return the observations of those points of `old` that `new` has too, by the indices of `new`: a point is the
        same where a keyframe sees it in the same pixel."""
        _, of_new, of_old = np.intersect1d(_keys(new), _keys(old), return_indices=True)
        to_new = np.full(len(old.points_in_world), -1, np.int64)
        to_new[old.obs_point[of_old]] = new.obs_point[of_new]
        point = to_new[self.obs_point]
        return FrameObservations(self.frame_id[point >= 0], point[point >= 0], self.obs_xy[point >= 0])

    def agreeing(
        self,
        points: NDArray[np.float64],
        row_of_frame: Mapping[int, int],
        camera: Intrinsics,
        cam_from_world: NDArray[np.float64],
        within: float,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return row, point (A,) and xy (A, 2) of the observations within so many pixels of where the pose
        cam_from_world (N, 4, 4) in the row of their frame puts their points (P, 3)."""
        row = np.array([row_of_frame.get(i, -1) for i in self.frame_id.tolist()], np.int64)
        known = row >= 0
        row, point, xy = row[known], self.obs_point[known], self.obs_xy[known].astype(np.float64)
        pose = cam_from_world[row]
        in_cam = np.einsum("oij,oj->oi", pose[:, :3, :3], points[point]) + pose[:, :3, 3]
        pixel, depth = project(in_cam, camera)
        agrees = (depth > 0) & (np.linalg.norm(pixel - xy, axis=1) <= within)
        return row[agrees], point[agrees], xy[agrees]


def _keys(model: SparseModel) -> NDArray:
    """(O,) records of the frame and the pixel of each observation, as the bits of its two numbers."""
    rows = np.empty(len(model.obs_frame), [("frame", np.int64), ("x", np.int64), ("y", np.int64)])
    rows["frame"] = model.frame_ids[model.obs_frame]
    rows["x"], rows["y"] = np.ascontiguousarray(model.obs_xy, np.float64).view(np.int64).T
    return rows
