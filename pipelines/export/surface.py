"""The zero surface of a sparse distance field as triangles: marching cubes chunk by chunk, welded, without floaters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from pipelines.export.volume import SIDE, Volume

CHUNK = 8
"""Blocks along the side of a chunk: dense memory is bounded by (CHUNK * SIDE + 1)³ voxels."""


def extract_surface(volume: Volume, least_weight: float) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """vertices (V, 3) in the world, faces (F, 3); only where all eight corners of a cell were seen."""
    index = {tuple(b): n for n, b in enumerate(volume.blocks.tolist())}
    chunks = np.unique(volume.blocks // CHUNK, axis=0)
    vertices, faces, count = [], [], 0
    for chunk in chunks:
        points, triangles = _chunk_surface(volume, index, chunk * CHUNK, least_weight)
        vertices.append(points)
        faces.append(triangles + count)
        count += len(points)
    if count == 0:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    return _weld(np.concatenate(vertices), np.concatenate(faces), volume.voxel)


def _chunk_surface(
    volume: Volume, index: dict[tuple[int, ...], int], first: NDArray[np.int32], least_weight: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surface in one chunk; its last layer of voxels is its neighbours' first, so that no cell is left out."""
    size = CHUNK * SIDE + 1
    distance = np.ones((size, size, size), np.float32)
    seen = np.zeros((size, size, size), bool)
    for dx in range(CHUNK + 1):
        for dy in range(CHUNK + 1):
            for dz in range(CHUNK + 1):
                n = index.get((int(first[0]) + dx, int(first[1]) + dy, int(first[2]) + dz))
                if n is None:
                    continue
                place = tuple(slice(d * SIDE, min(d * SIDE + SIDE, size)) for d in (dx, dy, dz))
                cut = tuple(slice(0, s.stop - s.start) for s in place)
                distance[place] = volume.distance[n][cut]
                seen[place] = volume.weight[n][cut] >= least_weight
    distance[~seen] = 1
    if distance.min() >= 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    # Free space is positive: "descent" makes the faces look that way.
    points, triangles, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    whole = _whole_cells(seen)
    cell = np.floor(points[triangles].mean(1)).astype(int).clip(0, size - 2)
    kept = triangles[whole[cell[:, 0], cell[:, 1], cell[:, 2]]]
    used = np.unique(kept)
    renumber = np.zeros(len(points), np.int64)
    renumber[used] = np.arange(len(used))
    return (points[used] + first * SIDE) * volume.voxel, renumber[kept]


def _whole_cells(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n-1, n-1, n-1): all eight corners were seen."""
    out = seen[:-1] & seen[1:]
    out = out[:, :-1] & out[:, 1:]
    return out[:, :, :-1] & out[:, :, 1:]


def _weld(
    points: NDArray[np.float64], faces: NDArray[np.int64], voxel: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices that neighbouring chunks both have become one; triangles that thereby lose their area go."""
    keys = np.round(points / (voxel * 1e-3)).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points[first].astype(np.float32), faces[real].astype(np.int32)


def without_floaters(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], least_share: float
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The connected pieces that have at least `least_share` of the faces of the largest one."""
    if len(faces) == 0:
        return vertices, faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges), bool), edges.T), shape=(len(vertices),) * 2)
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece[faces[:, 0]])
    kept = faces[(sizes >= least_share * sizes.max())[piece[faces[:, 0]]]]
    used = np.unique(kept)
    renumber = np.zeros(len(vertices), np.int32)
    renumber[used] = np.arange(len(used), dtype=np.int32)
    return vertices[used], renumber[kept]
