"""Cutting what is no floor, wall or ceiling into parts: graph-based segmentation over neighbouring voxels."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pipelines.proxy.regions.voxels import Voxels, find, neighbour_keys

_COLOR_UNIT = 12.0
"""Difference in CIE Lab that counts as much as a right angle between the normals."""
_SCALE = 60.0


def cut_parts(voxels: Voxels, largest: int) -> NDArray[np.int64]:
    """(V,) part of every voxel, 0 the largest by weight; parts beyond the `largest` join a neighbour or are -1.

    Efficient graph-based segmentation (Felzenszwalb and Huttenlocher, IJCV 2004) on the grid of voxels. A step of
    the surface that bends towards the viewer's side (concave) separates objects more than a convex one.
    """
    if len(voxels) == 0:
        return np.empty(0, np.int64)
    a, b, cost = _edges(voxels)
    order = np.lexsort((b, a, cost))
    root = _felzenszwalb(a[order], b[order], cost[order], voxels.weight / np.median(voxels.weight), _SCALE)
    return _absorb_small(root, a, b, cost, voxels.weight, largest)


def _edges(voxels: Voxels) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    around = find(voxels.keys, neighbour_keys(voxels.keys))
    a, k = np.nonzero(around > np.arange(len(voxels))[:, None])
    b = around[a, k]
    between = voxels.position[b] - voxels.position[a]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    bend = 1 - (voxels.normal[a] * voxels.normal[b]).sum(1)
    concave = (between * (voxels.normal[b] - voxels.normal[a])).sum(1) < 0
    color = np.linalg.norm((voxels.color[a] - voxels.color[b]) * [0.5, 1.0, 1.0], axis=1) / _COLOR_UNIT
    return a, b, color + np.where(concave, 1.0, 0.3) * bend


@njit(cache=True)
def _root(parent: NDArray[np.int64], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def _felzenszwalb(
    a: NDArray[np.int64], b: NDArray[np.int64], cost: NDArray[np.float64], weight: NDArray[np.float64], scale: float
) -> NDArray[np.int64]:
    parent = np.arange(len(weight))
    mass = weight.copy()
    inner = np.zeros(len(weight))
    for e in range(len(cost)):
        i, j = _root(parent, a[e]), _root(parent, b[e])
        if i != j and cost[e] <= min(inner[i] + scale / mass[i], inner[j] + scale / mass[j]):
            parent[j] = i
            mass[i] += mass[j]
            inner[i] = cost[e]
    for i in range(len(parent)):
        parent[i] = _root(parent, i)
    return parent


def _absorb_small(
    root: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    cost: NDArray[np.float64],
    weight: NDArray[np.float64],
    largest: int,
) -> NDArray[np.int64]:
    """Number the largest parts; the others join the numbered part they are bound to most cheaply, ring by ring."""
    ids, part = np.unique(root, return_inverse=True)
    mass = np.bincount(part, weights=weight)
    by_mass = np.lexsort((np.arange(len(ids)), -mass))
    rank = np.full(len(ids), -1, np.int64)
    rank[by_mass[:largest]] = np.arange(min(largest, len(ids)))
    order = np.lexsort((b, a, cost))
    pa, pb = part[a[order]], part[b[order]]
    while True:
        reached = (rank[pa] >= 0) != (rank[pb] >= 0)
        if not reached.any():
            break
        source = np.where(rank[pa] >= 0, pa, pb)[reached]
        target = np.where(rank[pa] >= 0, pb, pa)[reached]
        joined, first = np.unique(target, return_index=True)
        rank[joined] = rank[source[first]]
    return rank[part]
