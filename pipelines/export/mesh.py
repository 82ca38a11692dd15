"""The labelled mesh: rendered median depth fused, vertices coloured and labelled by the views that see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.config import ExportConfig
from pipelines.export.fusion import TRUNCATION, TsdfVolume, touched_blocks
from pipelines.progress import Progress
from pipelines.types import VOID, Intrinsics, SemanticMesh


@dataclass(frozen=True)
class SurfaceView:
    """What one camera sees of the map: depth (H, W) 0 = nothing, color (H, W, 3) uint8, labels (H, W), coverage (H, W)
    in 0..1."""

    cam_from_world: NDArray[np.float64]
    depth: NDArray[np.float32]
    color: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]


Draw = Callable[[int], SurfaceView]
"""Draws view number i. Called once a pass, so that not all views are held in memory."""


def fuse_mesh(
    draw: Draw, count: int, intrinsics: Intrinsics, class_count: int, settings: ExportConfig, progress: Progress
) -> SemanticMesh:
    """Fuse `count` views into a mesh with a colour and a label at each vertex; empty where there is no surface.

    The voxel is `mesh_voxel_px` pixels at the median depth, or larger where the blocks would not fit in
    `mesh_memory_mb`.
    """
    surfaces = [_for_fusion(draw(i)) for i in progress.track(range(count), "drawing the map", count)]
    voxel = _voxel_size(surfaces, intrinsics, settings)
    if voxel == 0:
        return _empty_mesh()
    volume = _allocate(surfaces, intrinsics, voxel, settings.mesh_memory_mb)
    for surface in progress.track(surfaces, "fusing depth", count):
        weight = surface.coverage / np.maximum(surface.depth, 1e-6) ** 2
        volume.integrate(surface.depth, weight.astype(np.float32), surface.cam_from_world, intrinsics)
    typical = float(np.median([np.median(s.depth[s.depth > 0]) for s in surfaces if (s.depth > 0).any()]))
    vertices, faces = volume.extract(settings.mesh_min_views / typical**2)
    vertices, faces = drop_floaters(vertices, faces, settings.mesh_min_part)
    if not len(faces):
        return _empty_mesh()
    colors, labels = paint_vertices(vertices, surfaces, intrinsics, class_count, volume.voxel_size)
    return SemanticMesh(vertices, faces, colors, labels)


def _for_fusion(view: SurfaceView) -> SurfaceView:
    """The view without the pixels at depth steps, whose depth belongs to neither side."""
    depth = view.depth
    steep = np.zeros(depth.shape, bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in (0, 1):
            step = np.abs(np.diff(depth, axis=axis)) > 0.05 * np.minimum(
                np.delete(depth, 0, axis=axis), np.delete(depth, -1, axis=axis)
            )
            low = np.s_[:-1, :] if axis == 0 else np.s_[:, :-1]
            high = np.s_[1:, :] if axis == 0 else np.s_[:, 1:]
            steep[low] |= step
            steep[high] |= step
    clean = np.where(steep, np.float32(0), depth)
    # Half precision holds the coverage of many views at a quarter of the memory.
    return SurfaceView(view.cam_from_world, clean, view.color, view.labels, view.coverage.astype(np.float16))


def _voxel_size(surfaces: Sequence[SurfaceView], intrinsics: Intrinsics, settings: ExportConfig) -> float:
    depths = [np.median(s.depth[s.depth > 0]) for s in surfaces if (s.depth > 0).any()]
    return float(np.median(depths)) / intrinsics.fx * settings.mesh_voxel_px if depths else 0.0


def _allocate(surfaces: Sequence[SurfaceView], intrinsics: Intrinsics, voxel: float, memory_mb: float) -> TsdfVolume:
    """The blocks that any view touches, with the smallest voxel that fits."""
    while True:
        keys = np.zeros(0, np.int64)
        for surface in surfaces:
            keys = np.union1d(keys, touched_blocks(surface.depth, surface.cam_from_world, intrinsics, voxel))
        if len(keys) * 4.1e-3 <= memory_mb:
            return TsdfVolume.empty(voxel, keys)
        voxel *= 1.3


def drop_floaters(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], min_part: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Without the connected parts that hold less than `min_part` of all faces."""
    if not len(faces):
        return vertices, faces
    n = len(vertices)
    ones = np.ones(2 * len(faces), dtype=np.int8)
    edges = (np.concatenate([faces[:, 0], faces[:, 1]]), np.concatenate([faces[:, 1], faces[:, 2]]))
    _, part = connected_components(coo_array((ones, edges), shape=(n, n)), directed=False)
    sizes = np.bincount(part[faces[:, 0]], minlength=part.max() + 1)
    faces = faces[sizes[part[faces[:, 0]]] >= min_part * len(faces)]
    used = np.unique(faces)
    place = np.zeros(n, dtype=np.int32)
    place[used] = np.arange(len(used), dtype=np.int32)
    return vertices[used], place[faces].astype(np.int32)


def paint_vertices(
    vertices: NDArray[np.float32],
    surfaces: Sequence[SurfaceView],
    intrinsics: Intrinsics,
    class_count: int,
    voxel: float,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """(V, 3) mean colours and (V,) majority labels over the views that see each vertex at its own depth."""
    total = np.zeros(len(vertices), np.float32)
    color = np.zeros((len(vertices), 3), np.float32)
    votes = np.zeros((len(vertices), class_count), np.float32)
    for view in surfaces:
        in_cam = vertices @ view.cam_from_world[:3, :3].T.astype(np.float32) + view.cam_from_world[:3, 3]
        z = in_cam[:, 2]
        ahead = np.flatnonzero(z > 1e-6)
        column = np.floor(in_cam[ahead, 0] / z[ahead] * intrinsics.fx + intrinsics.cx).astype(np.int64)
        row = np.floor(in_cam[ahead, 1] / z[ahead] * intrinsics.fy + intrinsics.cy).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < intrinsics.width) & (row < intrinsics.height)
        which, row, column = ahead[inside], row[inside], column[inside]
        agrees = np.abs(view.depth[row, column] - z[which]) < TRUNCATION * voxel
        which, row, column = which[agrees], row[agrees], column[agrees]
        weight = view.coverage[row, column].astype(np.float32) / z[which].astype(np.float32) ** 2
        total[which] += weight
        color[which] += weight[:, None] * view.color[row, column]
        label = view.labels[row, column]
        known = label < class_count
        votes[which[known], label[known]] += weight[known]
    colors = np.where(total[:, None] > 0, color / np.maximum(total, 1e-12)[:, None], 128)
    labels = np.where(votes.any(axis=1), votes.argmax(axis=1), VOID) if class_count else np.full(len(vertices), VOID)
    return np.round(colors).astype(np.uint8), labels.astype(np.uint8)


def _empty_mesh() -> SemanticMesh:
    return SemanticMesh(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8)
    )
