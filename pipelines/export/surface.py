"""The zero surface of a sparse distance field as triangles: marching cubes chunk by chunk, welded."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from ..system.jit import kernel
from .volume import CHUNK, SIDE, Volume, chunk_keys

_STEPS = 1000
"""Vertices within so small a part of a voxel are the same."""


@dataclass(frozen=True)
class Surface:
    """vertices (V, 3) in the world, faces (F, 3); pieces (V,), which connected piece each vertex belongs to, -1 without
    a face. The vertices `border` (N,), which those of other regions may be, have the places `border_places` (N, 3) in
    thousandths of a voxel."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    pieces: NDArray[np.int32]
    border: NDArray[np.int64]
    border_places: NDArray[np.int64]


Triangles = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Places (V, 3) and faces (F, 3)."""


def chunk_surfaces(volume: Volume, chunks: NDArray[np.int32], least_weight: float) -> list[Triangles]:
    """The surface in each of these chunks; only where all eight corners of a cell were seen."""
    index = {tuple(b): n for n, b in enumerate(volume.blocks.tolist())}
    ordered = chunks[np.lexsort(chunks.T[::-1])]
    return [_chunk_surface(volume, index, chunk * CHUNK, least_weight) for chunk in ordered]


def _chunk_surface(
    volume: Volume, index: dict[tuple[int, ...], int], first: NDArray[np.int32], least_weight: float
) -> Triangles:
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
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    # Free space is positive: "descent" makes the faces look that way.
    points, triangles, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    whole = _whole_cells(seen)
    cell = np.floor(points[triangles].mean(1)).astype(int).clip(0, size - 2)
    kept = triangles[whole[cell[:, 0], cell[:, 1], cell[:, 2]]]
    used = np.unique(kept)
    renumber = np.zeros(len(points), np.int32)
    renumber[used] = np.arange(len(used))
    return (points[used] + first * SIDE) * volume.voxel, renumber[kept]


def _whole_cells(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n-1, n-1, n-1): all eight corners were seen."""
    out = seen[:-1] & seen[1:]
    out = out[:, :-1] & out[:, 1:]
    return out[:, :, :-1] & out[:, :, 1:]


def weld(parts: Sequence[Triangles], chunks: NDArray[np.int32], voxel: float) -> Surface:
    """The surface in a region of chunks. Vertices that neighbouring ones both have become one; triangles that thereby
    lose their area go."""
    firsts = np.cumsum([0, *(len(points) for points, _ in parts)], dtype=np.int32)
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in parts)])
    keys = np.round(points / (voxel / _STEPS)).astype(np.int64)
    order = np.lexsort(keys.T[::-1])  # that of rows; np.unique's needs ten times the time and twice the memory
    is_new = np.ones(len(keys), bool)
    is_new[1:] = (keys[order[1:]] != keys[order[:-1]]).any(1)
    one = np.empty(len(keys), np.int32)
    one[order] = np.cumsum(is_new, dtype=np.int32) - np.int32(1)
    first = order[is_new]
    vertices, keys = points[first].astype(np.float32), keys[first]
    del points, order
    no_faces = np.zeros((0, 3), np.int32)
    faces = one[np.concatenate([no_faces, *(f + start for (_, f), start in zip(parts, firsts, strict=False))])]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    border = _border(keys, chunks)
    return Surface(vertices, faces, _pieces(faces, len(vertices)), border, keys[border])


def _border(places: NDArray[np.int64], chunks: NDArray[np.int32]) -> NDArray[np.int64]:
    """The rows of places on a side of a chunk that is not among these: the others know them too."""
    chunk, inside = np.divmod(places, CHUNK * SIDE * _STEPS)
    rows = np.flatnonzero((inside == 0).any(1))
    chunk, is_side, own = chunk[rows], inside[rows] == 0, chunk_keys(chunks)
    shared = np.zeros(len(rows), bool)
    for back in itertools.product((0, 1), repeat=3):
        shared |= is_side[:, np.flatnonzero(back)].all(1) & ~np.isin(chunk_keys(chunk - np.array(back)), own)
    return rows[shared]


def _pieces(faces: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """(count,) numbers from 0 of the connected pieces, -1 for a vertex without a face."""
    first = _firsts(faces, count)
    has_face = np.zeros(count, bool)
    has_face[faces.reshape(-1)] = True
    number = np.full(count, -1, np.int32)
    firsts = np.flatnonzero(has_face & (first == np.arange(count)))
    number[firsts] = np.arange(len(firsts))
    return np.where(has_face, number[first], np.int32(-1))


@kernel
def _firsts(faces, count):  # type: ignore[no-untyped-def]
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
    for v in range(count):  # none is before its first, so that that is known
        first[v] = first[first[v]]
    return first
