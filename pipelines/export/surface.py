"""The zero surface of a sparse distance field as triangles: marching cubes chunk by chunk, welded, without floaters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from pipelines.export.volume import CHUNK, SIDE, Volume
from pipelines.jit import kernel

_STEPS = 1000
"""Vertices within so small a part of a voxel are the same."""


@dataclass(frozen=True)
class Surface:
    """vertices (V, 3) in the world, faces (F, 3); the vertices `border` (N,) on the sides of chunks, which those of the
    next region may be, have the places `border_places` (N, 3) in thousandths of a voxel."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    border: NDArray[np.int64]
    border_places: NDArray[np.int64]


EMPTY = Surface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, int), np.zeros((0, 3), int))


def extract_surface(volume: Volume, chunks: NDArray[np.int32], least_weight: float) -> Surface:
    """The surface in these chunks; only where all eight corners of a cell were seen."""
    index = {tuple(b): n for n, b in enumerate(volume.blocks.tolist())}
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for chunk in chunks[np.lexsort(chunks.T[::-1])]:
        points, triangles = _chunk_surface(volume, index, chunk * CHUNK, least_weight)
        vertices.append(points)
        faces.append(triangles + count)
        count += len(points)
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


def _weld(points: NDArray[np.float64], faces: NDArray[np.int64], voxel: float) -> Surface:
    """Vertices that neighbouring chunks both have become one; triangles that thereby lose their area go."""
    keys = np.round(points / (voxel / _STEPS)).astype(np.int64)
    keys, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    real = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    border = np.flatnonzero((keys % (CHUNK * SIDE * _STEPS) == 0).any(1))
    return Surface(points[first].astype(np.float32), faces[real].astype(np.int32), border, keys[border])


def join_faces(surfaces: Sequence[Surface]) -> NDArray[np.int32]:
    """(F, 3) all faces, as rows of all vertices one after the other; of vertices that several have one is used."""
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    together = list(zip(surfaces, starts.tolist(), strict=False))
    rows = np.concatenate([s.border + start for s, start in together])
    _, first, inverse = np.unique(
        np.concatenate([s.border_places for s in surfaces]), axis=0, return_index=True, return_inverse=True
    )
    stands_for = np.arange(starts[-1], dtype=np.int32)
    stands_for[rows] = rows[first][inverse.reshape(-1)]
    faces, done = np.empty((sum(len(s.faces) for s in surfaces), 3), np.int32), 0
    for s, start in together:
        faces[done : done + len(s.faces)] = stands_for[start:][s.faces]
        done += len(s.faces)
    return faces


def without_floaters(
    faces: NDArray[np.int32], count: int, least_share: float
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Of the connected pieces that have at least `least_share` of the faces of the largest one: the rows (V,) that they
    use of `count` vertices, and their faces (F, 3) as rows of those."""
    if len(faces) == 0:
        return np.zeros(0, np.int64), faces
    piece = _pieces(faces, count)[faces[:, 0]]
    sizes = np.bincount(piece)
    kept = faces[sizes[piece] >= least_share * sizes.max()]
    is_used = np.zeros(count, bool)
    is_used[kept.reshape(-1)] = True
    renumber = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(is_used), renumber[kept]


@kernel
def _pieces(faces, count):  # type: ignore[no-untyped-def]
    """(count,) the first vertex of the piece that each belongs to."""
    first = np.arange(count).astype(np.int32)
    for f in range(len(faces)):
        for k in range(2):
            a, b = faces[f, k], faces[f, k + 1]
            while first[a] != a:
                first[a] = first[first[a]]
                a = first[a]
            while first[b] != b:
                first[b] = first[first[b]]
                b = first[b]
            if a < b:
                first[b] = a
            else:
                first[a] = b
    for v in range(count):  # none stands before its first, so that that is known
        first[v] = first[first[v]]
    return first
