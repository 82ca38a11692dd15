"""A depth image with its camera: what the views of a scene are compared by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.camera import project, unproject
from pipelines.types import Intrinsics

Array = NDArray[np.float64]

NEIGHBOURS = 16
_LEAST_OVERLAP = 0.2
_OVERLAP_SAMPLES = 16


@dataclass(frozen=True)
class PosedDepth:
    """depth (H, W) float32, 0 = unknown, and trust (H, W) 0..1 of a camera cam_from_world (4, 4)."""

    intrinsics: Intrinsics
    cam_from_world: Array
    depth: NDArray[np.float32]
    trust: NDArray[np.float32]

    def grid(self, across: int) -> tuple[Array, Array, NDArray[np.float64]]:
        """xy (S, 2), depth (S,) and trust (S,) of the known pixels of a coarse grid, `across` over the width."""
        stride = max(self.intrinsics.width // across, 1)
        picked = (slice(stride // 2, None, stride),) * 2
        depth, trust = self.depth[picked].astype(np.float64), self.trust[picked].astype(np.float64)
        rows, columns = np.nonzero(depth > 0)
        xy = np.stack([columns, rows], 1).astype(np.float64) * stride + (stride // 2 + 0.5)
        return xy, depth[rows, columns], trust[rows, columns]

    def in_world(self, xy: Array, depth: Array) -> Array:
        """(Q, 3) the points at pixels (Q, 2) and depths (Q,)."""
        world_from_cam = np.linalg.inv(self.cam_from_world)
        return unproject(xy, depth, self.intrinsics) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]

    def seen(self, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """xy (Q, 2), z (Q,) of points (Q, 3) of the world, and which lie inside the picture, before the camera."""
        xy, z = project(points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3], self.intrinsics)
        # Pixels of points behind the camera are NaN, which compares false.
        inside = np.all((xy >= 0) & (xy < (self.intrinsics.width, self.intrinsics.height)), axis=1)
        return xy, z, np.asarray(inside, dtype=bool)


def overlaps(views: Sequence[PosedDepth]) -> Array:
    """(N, N) η[i, j], MSGS-SLAM eq. (10): the fraction of view i's back-projected samples inside view j's image."""
    out = np.eye(len(views))
    for i, view in enumerate(views):
        xy, depth, _ = view.grid(_OVERLAP_SAMPLES)
        if len(xy) == 0:
            continue
        points = view.in_world(xy, depth)
        for j, other in enumerate(views):
            out[i, j] = other.seen(points)[2].mean()
    return out


def neighbours(views: Sequence[PosedDepth]) -> list[tuple[int, int]]:
    """Ordered pairs of views that see the same; of many, a spread over near and far ones."""
    pairs = []
    for i, row in enumerate(overlaps(views)):
        seeing = [int(j) for j in np.argsort(-row, kind="stable") if j != i and row[j] > _LEAST_OVERLAP]
        pairs += [(i, j) for j in seeing[:: max(len(seeing) // NEIGHBOURS, 1)][:NEIGHBOURS]]
    return pairs
