"""A depth image with its camera: what the views of a scene are compared by."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..types import Array, Intrinsics
from .camera import project, unproject

NEIGHBOURS = 16
_MIN_OVERLAP = 0.2
_OVERLAP_SAMPLES = 16
CANDIDATES = 256
_REACH = 1.5
"""A point farther from a camera than this times the depth shown there is occluded."""


@dataclass(frozen=True)
class PosedDepth:
    """depth (H, W) float32, 0 = unknown, and trust (H, W) 0..1 of a camera cam_from_world (4, 4)."""

    intrinsics: Intrinsics
    cam_from_world: Array
    depth: NDArray[np.float32]
    trust: NDArray[np.float32]

    def grid(self, across: int) -> tuple[Array, Array, NDArray[np.float64]]:
        """xy (S, 2), depth (S,) and trust (S,) of the known pixels of a coarse grid, `across` along the longer
        side."""
        stride = max(max(self.intrinsics.width, self.intrinsics.height) // across, 1)
        sampled = (slice(stride // 2, None, stride),) * 2
        depth, trust = self.depth[sampled].astype(np.float64), self.trust[sampled].astype(np.float64)
        rows, columns = np.nonzero(depth > 0)
        xy = np.stack([columns, rows], 1).astype(np.float64) * stride + (stride // 2 + 0.5)
        return xy, depth[rows, columns], trust[rows, columns]

    def in_world(self, xy: Array, depth: Array) -> Array:
        """(Q, 3) the points at pixels (Q, 2) and depths (Q,)."""
        world_from_cam = np.linalg.inv(self.cam_from_world)
        return unproject(xy, depth, self.intrinsics) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]

    def seen(self, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """xy (Q, 2), z (Q,) of points (Q, 3) of the world, and which lie inside the image, before the camera."""
        xy, z = project(points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3], self.intrinsics)
        # Pixels of points behind the camera are NaN, which compares false.
        inside = np.all((xy >= 0) & (xy < (self.intrinsics.width, self.intrinsics.height)), axis=1)
        return xy, z, np.asarray(inside, dtype=bool)


def overlaps(views: Iterable[PosedDepth]) -> sparse.csr_matrix:
    """(N, N) η[i, j], MSGS-SLAM eq. (10): the fraction of view i's back-projected samples inside view j's image.

    Only where view j may see what i shows: where that is no farther from j than what j itself shows, and in the
    spread over near and far ones of at most CANDIDATES views. So the cost grows with the number of views, not with its
    square.
    """
    seen, poses, projections, picture_sizes = [], [], [], []
    for view in views:  # once: they may be read from disk
        xy, depth, _ = view.grid(_OVERLAP_SAMPLES)
        seen.append(view.in_world(xy, depth))
        poses.append(view.cam_from_world)
        projections.append(view.intrinsics.matrix @ view.cam_from_world[:3])
        picture_sizes.append((view.intrinsics.width, view.intrinsics.height))
    centers: Array = np.linalg.inv(np.array(poses).reshape(-1, 4, 4))[:, :3, 3].astype(np.float64)
    reach = np.array([_largest(np.linalg.norm(p - c, axis=1)) for p, c in zip(seen, centers, strict=True)])
    near = _Candidates(centers, _REACH * reach)
    matrices, sizes = np.array(projections).reshape(-1, 3, 4), np.array(picture_sizes).reshape(-1, 2)
    rows, columns, shares = [], [], []
    for i, points in enumerate(seen):
        others = near.of(i, points)
        inside = _inside(points, matrices[others], sizes[others]).mean(1) if len(points) else np.zeros(0)
        share = np.where(others == i, 1.0, inside) if len(points) else np.ones(len(others))
        rows.append(np.full(len(others), i))
        columns.append(others)
        shares.append(share)
    places = (_joined(rows), _joined(columns))
    found = sparse.csr_matrix((np.concatenate([np.zeros(0), *shares]), places), (len(seen), len(seen)))
    found.eliminate_zeros()
    return found


@dataclass(frozen=True)
class _Candidates:
    """Which cameras may see points, by their centres (N, 3) and how far they see, reach (N,)."""

    centers: Array
    reach: Array

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.centers)

    def of(self, index: int, points: Array) -> NDArray[np.int64]:
        """Sorted indices, `index` among them."""
        if len(points) == 0:
            return np.array([index])
        middle = points.mean(0)
        radius = _largest(np.linalg.norm(points - middle, axis=1))
        others = np.sort(np.array(self._tree.query_ball_point(middle, self.reach.max() + radius), np.int64))
        distance = np.linalg.norm(self.centers[others] - middle, axis=1)
        others = others[(distance <= self.reach[others] + radius) & (others != index)]
        if len(others) > CANDIDATES:
            apart = np.linalg.norm(self.centers[others] - self.centers[index], axis=1)
            spread = np.linspace(0, len(others) - 1, CANDIDATES).astype(int)
            others = others[np.argsort(apart, kind="stable")[spread]]
        return np.sort(np.append(others, index))


def _inside(points: Array, matrices: Array, sizes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(C, Q) whether points (Q, 3) lie inside the images of cameras with projections (C, 3, 4)."""
    u, v, z = np.moveaxis(matrices[:, :, :3] @ points.T + matrices[:, :, 3:], 1, 0)
    width, height = sizes[:, :1], sizes[:, 1:]
    return np.asarray((z > 0) & (u >= 0) & (u < width * z) & (v >= 0) & (v < height * z))


def _largest(distances: Array) -> float:
    """Of all but the farthest twentieth, which may be errors; 0 of none."""
    return float(np.percentile(distances, 95)) if len(distances) else 0.0


def _joined(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate([np.zeros(0, np.int64), *parts])


def neighbours(views: Iterable[PosedDepth]) -> list[tuple[int, int]]:
    """Ordered pairs of views that see the same; of many, a spread over near and far ones."""
    pairs = []
    overlap = overlaps(views)
    for i in range(overlap.shape[0]):
        row = slice(overlap.indptr[i], overlap.indptr[i + 1])
        others, share = overlap.indices[row], overlap.data[row]
        order = np.argsort(-share, kind="stable")
        seeing = [int(others[n]) for n in order if others[n] != i and share[n] > _MIN_OVERLAP]
        pairs += [(i, j) for j in seeing[:: max(len(seeing) // NEIGHBOURS, 1)][:NEIGHBOURS]]
    return pairs
