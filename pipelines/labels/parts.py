"""Cutting what is no floor, wall or ceiling into parts: graph-based segmentation over neighbouring voxels
(Felzenszwalb and Huttenlocher, IJCV 2004)."""

import numpy as np
from numpy.typing import NDArray

from ..geometry.voxels import Voxels, touching
from ..system.jit import kernel

_COLOR_UNIT = 12.0
"""Difference in CIE Lab that counts as much as a right angle between the normals."""
_BLOCK = 500_000
"""Edges that are weighed together."""
_SCALE = 20.0
_PATCH_SCALE = 3.0
"""Of 1 to 20 that which, with the votes of a network averaged in each patch, named rooms best (two recordings)."""


def cut_parts(voxels: Voxels, largest: int) -> NDArray[np.int64]:
    """(V,) part of every voxel, 0 the largest by weight; parts beyond the `largest` join a neighbour or are -1.

    The graph joins neighbouring voxels. Where the surface bends towards the viewer (concave) objects touch, so that
    separates more than a convex edge.
    """
    if len(voxels) == 0:
        return np.empty(0, np.int64)
    a, b, cost = _edges(voxels)
    part = cut_graph(a, b, cost, voxels.weight / np.median(voxels.weight), _SCALE).astype(np.int32)
    return _absorb_small(part, a, b, cost, voxels.weight, largest)


def cut_patches(voxels: Voxels) -> NDArray[np.int64]:
    """(V,) small patches of like colour and slope, numbered from 0: an object is made of some tens of them."""
    if len(voxels) == 0:
        return np.empty(0, np.int64)
    return cut_graph(*_edges(voxels), voxels.weight / np.median(voxels.weight), _PATCH_SCALE)


def _edges(voxels: Voxels) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    a, b = touching(voxels.keys)
    cost = np.empty(len(a))
    for start in range(0, len(a), _BLOCK):
        block = slice(start, start + _BLOCK)
        cost[block] = _costs(voxels, a[block], b[block])
    return a, b, cost


def _costs(voxels: Voxels, a: NDArray[np.int32], b: NDArray[np.int32]) -> NDArray[np.float64]:
    between = voxels.position[b] - voxels.position[a]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    bend = 1 - (voxels.normal[a] * voxels.normal[b]).sum(1)
    concave = (between * (voxels.normal[b] - voxels.normal[a])).sum(1) < 0
    color = np.linalg.norm((voxels.color[a] - voxels.color[b]) * [0.5, 1.0, 1.0], axis=1) / _COLOR_UNIT
    return np.asarray(color + np.where(concave, 1.0, 0.3) * bend)


def _absorb_small(
    part: NDArray[np.int32],
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    cost: NDArray[np.float64],
    weight: NDArray[np.float64],
    largest: int,
) -> NDArray[np.int64]:
    """Number the largest parts; the others join the numbered part they are bound to most cheaply, ring by ring."""
    mass = np.bincount(part, weights=weight)
    by_mass = np.lexsort((np.arange(len(mass)), -mass))
    rank = np.full(len(mass), -1, np.int64)
    rank[by_mass[:largest]] = np.arange(min(largest, len(mass)))
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


def cut_graph(
    a: NDArray[np.integer], b: NDArray[np.integer], cost: NDArray[np.float64], mass: NDArray[np.float64], scale: float
) -> NDArray[np.int64]:
    """(V,) component of every node, numbered from 0, for edges a-b (E,) with a cost each.

    Two components join when the edge costs no more than the dearest edge inside either plus `scale` over its mass.
    """
    root = _join(np.lexsort((b, a, cost)), a, b, cost, mass, scale)
    return np.unique(root, return_inverse=True)[1]


@kernel
def _root(parent: NDArray[np.int64], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def _join(
    order: NDArray[np.int64],
    a: NDArray[np.integer],
    b: NDArray[np.integer],
    cost: NDArray[np.float64],
    mass: NDArray[np.float64],
    scale: float,
) -> NDArray[np.int64]:
    parent = np.arange(len(mass))
    total = mass.copy()
    inner = np.zeros(len(mass))
    for e in order:
        i, j = _root(parent, a[e]), _root(parent, b[e])
        if i != j and cost[e] <= min(inner[i] + scale / total[i], inner[j] + scale / total[j]):
            parent[j] = i
            total[i] += total[j]
            inner[i] = cost[e]
    for i in range(len(parent)):
        parent[i] = _root(parent, i)
    return parent
