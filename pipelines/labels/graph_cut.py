"""Efficient graph-based segmentation (Felzenszwalb and Huttenlocher, IJCV 2004) over any graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..system.jit import kernel


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
