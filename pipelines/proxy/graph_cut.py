"""Efficient graph-based segmentation (Felzenszwalb and Huttenlocher, IJCV 2004) over any graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.system.jit import kernel


def cut_graph(
    a: NDArray[np.integer], b: NDArray[np.integer], cost: NDArray[np.float64], mass: NDArray[np.float64], scale: float
) -> NDArray[np.int64]:
    """(V,) component of every node, numbered from 0, for edges a-b (E,) with a cost each.

    Two components join when the edge costs no more than the dearest edge inside either plus `scale` over its mass.
    """
    root = _join(np.lexsort((b, a, cost)), a, b, cost, mass, scale)
    return np.unique(root, return_inverse=True)[1]


def cut_image(image: NDArray[np.uint8], scale: float) -> NDArray[np.int64]:
    """(h, w) regions of like colour of an RGB image (h, w, 3); costs are colour differences in grey levels."""
    height, width = image.shape[:2]
    index = np.arange(height * width).reshape(height, width)
    color = image.astype(np.float64)
    pairs, costs = [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = (slice(0, height - dy), slice(max(0, -dx), width - max(0, dx)))
        there = (slice(dy, height), slice(max(0, dx), width + min(0, dx)))
        pairs.append(np.stack([index[here].ravel(), index[there].ravel()]))
        costs.append(np.sqrt(((color[here] - color[there]) ** 2).sum(-1)).ravel())
    a, b = np.concatenate(pairs, axis=1)
    return cut_graph(a, b, np.concatenate(costs), np.ones(height * width), scale).reshape(height, width)


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
