"""Truncated signed distance fusion of depth images into sparse blocks of voxels (Curless and Levoy 1996)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from pipelines.gaussians.render.jit import kernel
from pipelines.gaussians.render.threads import for_each
from pipelines.types import Intrinsics

BLOCK = 8
"""Voxels along a block's side."""
TRUNCATION = 4
"""Distances are kept up to this many voxels from a surface."""
_CHUNK = 16
"""Blocks along the side of the dense piece that marching cubes gets at once."""
_BITS = 20
"""A block's three coordinates are packed into one integer of 3 x 20 bits."""


@dataclass
class TsdfVolume:
    """B sparse blocks: keys (B,) int64 sorted, distances (B, 8, 8, 8) in voxels -4..4, weights (B, 8, 8, 8); float32.

    Voxel (i, j, k) of the world has its centre at (i, j, k) * voxel_size.
    """

    voxel_size: float
    keys: NDArray[np.int64]
    distances: NDArray[np.float32]
    weights: NDArray[np.float32]

    @staticmethod
    def empty(voxel_size: float, keys: NDArray[np.int64]) -> TsdfVolume:
        """Unobserved blocks; 4 kB each."""
        shape = (len(keys), BLOCK, BLOCK, BLOCK)
        return TsdfVolume(voxel_size, keys, np.full(shape, TRUNCATION, np.float32), np.zeros(shape, np.float32))

    def integrate(
        self,
        depth: NDArray[np.float32],
        weight: NDArray[np.float32],
        cam_from_world: NDArray[np.float64],
        intrinsics: Intrinsics,
    ) -> None:
        """Average a depth image (H, W), 0 = unknown, into the blocks before and just behind its surface."""
        camera = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
        origins = (unpack_keys(self.keys) * BLOCK).astype(np.int64)
        pose = np.ascontiguousarray(cam_from_world[:3], dtype=np.float64)
        band = 256

        def work(n: int) -> None:
            part = slice(n * band, (n + 1) * band)
            _integrate_blocks(
                origins[part], self.distances[part], self.weights[part], depth, weight, pose, camera, self.voxel_size
            )

        for_each(work, math.ceil(len(self.keys) / band))

    def extract(self, min_weight: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Vertices (V, 3) in the world and faces (F, 3) of the zero surface among voxels of at least `min_weight`."""
        positions = unpack_keys(self.keys)
        chunk_keys = pack_keys(positions // _CHUNK)
        corners, faces, count = [], [], 0
        for key in np.unique(chunk_keys):
            start = unpack_keys(np.array([key]))[0] * _CHUNK
            found = self._extract_chunk(start, positions, min_weight)
            if found is not None:
                corners.append(found[0])
                faces.append(found[1] + count)
                count += len(found[0])
        if not corners:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
        return weld(np.concatenate(corners), np.concatenate(faces), self.voxel_size)

    def _extract_chunk(
        self, start: NDArray[np.int64], positions: NDArray[np.int64], min_weight: float
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
        """One chunk with a rim of one block on its far sides, so that neighbours meet at shared vertices."""
        near = np.flatnonzero(((positions >= start) & (positions <= start + _CHUNK)).all(axis=1))
        side = (_CHUNK + 1) * BLOCK
        values = np.full((side, side, side), TRUNCATION, np.float32)
        seen = np.zeros((side, side, side), bool)
        for n in near:
            x, y, z = (positions[n] - start) * BLOCK
            place = np.s_[x : x + BLOCK, y : y + BLOCK, z : z + BLOCK]
            values[place] = self.distances[n]
            seen[place] = self.weights[n] >= min_weight
        size = _CHUNK * BLOCK + 1
        values, seen = values[:size, :size, :size], seen[:size, :size, :size]
        mask = _cell_mask(seen)
        if not (mask.any() and values[seen].min() < 0 < values[seen].max()):
            return None
        try:
            vertices, faces, _, _ = marching_cubes(values, 0.0, mask=mask)
        except RuntimeError:  # no cell of the mask holds the surface
            return None
        return (vertices.astype(np.float64) + start * BLOCK) * self.voxel_size, faces.astype(np.int64)


def _cell_mask(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Marching cubes looks at the far corner of a cell alone: true there where all eight corners are seen."""
    mask = np.zeros_like(seen)
    cells = np.ones(tuple(s - 1 for s in seen.shape), bool)
    for dx in (0, 1):
        for dy in (0, 1):
            for dz in (0, 1):
                cells &= seen[dx : dx + cells.shape[0], dy : dy + cells.shape[1], dz : dz + cells.shape[2]]
    mask[1:, 1:, 1:] = cells
    return mask


def weld(
    corners: NDArray[np.float64], faces: NDArray[np.int64], voxel_size: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Join vertices closer than a thousandth of a voxel; drop faces that lose a corner by it."""
    grid = np.round(corners / (voxel_size * 1e-3)).astype(np.int64)
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    joined = place.reshape(-1)[faces]
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return corners[first].astype(np.float32), joined[whole].astype(np.int32)


def touched_blocks(
    depth: NDArray[np.float32], cam_from_world: NDArray[np.float64], intrinsics: Intrinsics, voxel_size: float
) -> NDArray[np.int64]:
    """Sorted keys of the blocks within the truncation of the surface that a depth image (H, W) shows."""
    rows, columns = np.nonzero(depth[::2, ::2])
    d = depth[::2, ::2][rows, columns].astype(np.float64)
    x = (columns * 2 + 0.5 - intrinsics.cx) / intrinsics.fx
    y = (rows * 2 + 0.5 - intrinsics.cy) / intrinsics.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    world_from_cam = np.linalg.inv(cam_from_world)
    reach = TRUNCATION * voxel_size
    keys = []
    for offset in (-reach, -reach / 2, 0.0, reach / 2, reach):
        points = rays * (d + offset)[:, None] @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        keys.append(np.unique(pack_keys(np.floor(points / (voxel_size * BLOCK)).astype(np.int64))))
    return np.unique(np.concatenate(keys))


def pack_keys(positions: NDArray[np.int64]) -> NDArray[np.int64]:
    """(B, 3) block coordinates to (B,) sortable integers. Raises ValueError beyond 2^19 blocks from the origin."""
    shifted = positions + (1 << (_BITS - 1))
    if len(shifted) and (shifted.min() < 0 or shifted.max() >= 1 << _BITS):
        raise ValueError("the scene is too large for its voxels: choose larger ones")
    return (shifted[:, 0] << (2 * _BITS)) | (shifted[:, 1] << _BITS) | shifted[:, 2]


def unpack_keys(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Inverse of `pack_keys`."""
    low = (1 << _BITS) - 1
    return np.stack([keys >> (2 * _BITS), (keys >> _BITS) & low, keys & low], axis=1) - (1 << (_BITS - 1))


@kernel
def _integrate_blocks(origins, distances, weights, depth, weight, pose, camera, voxel_size):  # type: ignore[no-untyped-def] # fmt: skip
    height, width = depth.shape
    for b in range(origins.shape[0]):
        for i in range(BLOCK):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    wx = (origins[b, 0] + i) * voxel_size
                    wy = (origins[b, 1] + j) * voxel_size
                    wz = (origins[b, 2] + k) * voxel_size
                    z = pose[2, 0] * wx + pose[2, 1] * wy + pose[2, 2] * wz + pose[2, 3]
                    if z <= 0:
                        continue
                    x = pose[0, 0] * wx + pose[0, 1] * wy + pose[0, 2] * wz + pose[0, 3]
                    y = pose[1, 0] * wx + pose[1, 1] * wy + pose[1, 2] * wz + pose[1, 3]
                    column = math.floor(x / z * camera[0] + camera[2])
                    row = math.floor(y / z * camera[1] + camera[3])
                    if column < 0 or row < 0 or column >= width or row >= height:
                        continue
                    d = depth[row, column]
                    if d <= 0:
                        continue
                    signed = (d - z) / voxel_size
                    if signed < -TRUNCATION:
                        continue
                    w = weight[row, column]
                    total = weights[b, i, j, k] + w
                    if total > 0:
                        value = distances[b, i, j, k] * weights[b, i, j, k] + min(signed, float(TRUNCATION)) * w
                        distances[b, i, j, k] = value / total
                        weights[b, i, j, k] = total
