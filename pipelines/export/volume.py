"""A truncated signed distance field in sparse blocks: depth images in, distances out (Curless and Levoy 1996)."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.depth.posed import PosedDepth
from pipelines.gaussians.render.jit import kernel
from pipelines.geometry.camera import unproject_depth
from pipelines.proxy.regions.voxels import cells_of, voxel_keys

SIDE = 8
"""Voxels along the side of a block."""


@dataclass(frozen=True)
class Volume:
    """blocks (B, 3) int32, sorted block coordinates; distance and weight (B, SIDE, SIDE, SIDE) float32, x first.

    Voxel (i, j, k) of block b lies at (SIDE * blocks[b] + (i, j, k)) * voxel. distance is in units of the truncation,
    positive in front of the surface.
    """

    voxel: float
    truncation: float
    blocks: NDArray[np.int32]
    distance: NDArray[np.float32]
    weight: NDArray[np.float32]


def touched_blocks(views: list[PosedDepth], voxel: float, truncation: float) -> NDArray[np.int32]:
    """(B, 3) coordinates of the blocks within the truncation of a seen surface, sorted.

    Those further than a million blocks from the origin are left out.
    """
    # One number a block: rows of three are sorted ten times as slowly.
    found = np.zeros(0, np.int64)
    for view in views:
        world_from_cam = np.linalg.inv(view.cam_from_world)
        points = unproject_depth(view.depth, view.intrinsics)[::3, ::3]
        points = points[(view.trust[::3, ::3] > 0) & (view.depth[::3, ::3] > 0)]
        rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
        offsets = np.arange(-1, 1.01, 0.5)[:, None, None] * truncation
        near = ((points + offsets * rays).reshape(-1, 3)) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        found = np.unique(np.concatenate([found, np.unique(voxel_keys(near, voxel * SIDE))]))
    return cells_of(found[found >= 0]).astype(np.int32)


def fuse(views: list[PosedDepth], voxel: float, truncation_voxels: float, max_blocks: int, threads: int) -> Volume:
    """The weighted mean of all views' truncated distances; the voxels grow until at most `max_blocks` are needed."""
    blocks = touched_blocks(views, voxel, voxel * truncation_voxels)
    while len(blocks) > max_blocks:
        voxel *= 1.25
        blocks = touched_blocks(views, voxel, voxel * truncation_voxels)
    truncation = voxel * truncation_voxels
    distance = np.zeros((len(blocks), SIDE, SIDE, SIDE), np.float32)
    weight = np.zeros_like(distance)
    bounds = np.linspace(0, len(blocks), threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        for view in views:
            k = view.intrinsics
            camera = np.array([k.fx, k.fy, k.cx, k.cy])
            jobs = [
                pool.submit(
                    _integrate, blocks[a:b], distance[a:b], weight[a:b], view.depth, view.trust,
                    np.ascontiguousarray(view.cam_from_world), camera, voxel, truncation,
                )
                for a, b in itertools.pairwise(bounds)
            ]  # fmt: skip
            for job in jobs:
                job.result()
    return Volume(voxel, truncation, blocks, distance, weight)


@kernel
def _integrate(blocks, distance, weight, depth, depth_weight, pose, camera, voxel, truncation):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    fx, fy, cx, cy = camera
    radius = voxel * SIDE * 0.87
    for b in range(len(blocks)):
        bx, by, bz = blocks[b, 0] * SIDE * voxel, blocks[b, 1] * SIDE * voxel, blocks[b, 2] * SIDE * voxel
        half = voxel * SIDE / 2
        mx, my, mz = bx + half, by + half, bz + half
        z = pose[2, 0] * mx + pose[2, 1] * my + pose[2, 2] * mz + pose[2, 3]
        if z < -radius:
            continue
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    x, y, w = bx + i * voxel, by + j * voxel, bz + k * voxel
                    zc = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * w + pose[2, 3]
                    if zc <= 1e-6:
                        continue
                    xc = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * w + pose[0, 3]
                    yc = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * w + pose[1, 3]
                    u, v = fx * xc / zc + cx, fy * yc / zc + cy
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    column, row = int(u), int(v)
                    d, share = depth[row, column], depth_weight[row, column]
                    if d <= 0 or share <= 0 or d - zc < -truncation:
                        continue
                    value = min(1.0, (d - zc) / truncation)
                    total = weight[b, i, j, k] + share
                    distance[b, i, j, k] += (value - distance[b, i, j, k]) * share / total
                    weight[b, i, j, k] = total
