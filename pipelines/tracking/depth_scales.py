"""How proxy depths relate to triangulated structure: one scale for the world, one smooth field for each keyframe.

A shift is no part of a field: depth that is known only up to one is given it before (`pipelines.proxy.aligned`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Intrinsics, ProxyMaps

Array = NDArray[np.float64]

ROWS, COLUMNS = 3, 4
"""Nodes of a field."""
DEPTH_SD = 0.05
"""Relative standard deviation of a reliable proxy depth after its scale is known."""
MIN_RELIABILITY = 0.1
NODE_SD = 0.06
"""How far, relatively, a node of a field strays from its keyframe's scale."""
STEP_SD = 0.05
"""How much neighbouring nodes differ."""


@dataclass(frozen=True)
class WorldScale:
    """The factor that makes the world metric, its relative standard deviation and the keyframes it comes from."""

    factor: float
    relative_sd: float
    keyframes: int


def sample_proxy(maps: ProxyMaps, xy: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Proxy depth (Q,), 0 where unknown, and reliability U (Q,) at pixels (Q, 2) of the frame; nearest neighbour."""
    height, width = maps.depth.shape
    column = np.clip((xy[:, 0] * width / intrinsics.width).astype(int), 0, width - 1)
    row = np.clip((xy[:, 1] * height / intrinsics.height).astype(int), 0, height - 1)
    reliability = maps.confidence[row, column].astype(np.float64)
    depth = maps.depth[row, column].astype(np.float64)
    return np.where(reliability >= MIN_RELIABILITY, depth, 0.0), reliability


def weighted_median(values: Array, weights: Array) -> float:
    """The value with half of the weight on either side."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])


def keyframe_scale(log_ratio: Array, weights: Array) -> float:
    """Robust log scale of one keyframe from log(depth in the world / proxy depth) at its points; 0 without points."""
    return weighted_median(log_ratio, weights) if len(log_ratio) and weights.sum() > 0 else 0.0


def world_scale(log_scales: Array) -> WorldScale:
    """The factor on the world that makes the keyframes' proxies right on average, from their log scales (N,).

    The mean without those beyond three robust sigmas. The uncertainty counts only independent keyframes: errors of
    neighbours are alike, which the correlation of successive ones tells.
    """
    deviation = log_scales - np.median(log_scales)
    sigma = 1.4826 * float(np.median(np.abs(deviation)))
    used = log_scales[np.abs(deviation) <= 3 * max(sigma, 1e-6)]
    mean, n = float(used.mean()), len(used)
    rest = used - mean
    correlation = float(rest[1:] @ rest[:-1] / max(float(rest @ rest), 1e-12)) if n > 2 else 0.0
    independent = max(n * (1 - correlation) / (1 + correlation), 1.0) if correlation > 0 else n
    return WorldScale(float(np.exp(-mean)), float(used.std() / np.sqrt(max(independent, 1.0))), n)


def bilinear_basis(xy: Array, intrinsics: Intrinsics, rows: int = ROWS, columns: int = COLUMNS) -> Array:
    """(Q, rows * columns) weights of a grid's nodes, which span the picture corner to corner, at pixels (Q, 2)."""
    gx = np.clip(xy[:, 0] / intrinsics.width, 0, 1) * (columns - 1)
    gy = np.clip(xy[:, 1] / intrinsics.height, 0, 1) * (rows - 1)
    wx = np.clip(1 - np.abs(gx[:, None] - np.arange(columns)), 0, 1)
    wy = np.clip(1 - np.abs(gy[:, None] - np.arange(rows)), 0, 1)
    return (wy[:, :, None] * wx[:, None, :]).reshape(len(xy), rows * columns)


def fit_field(basis: Array, log_ratio: Array, weights: Array) -> Array:
    """(ROWS, COLUMNS) log scales of one keyframe: robust, smooth, near its median where there are few points.

    basis (Q, ROWS * COLUMNS), log_ratio (Q,) and weights (Q,) as for `keyframe_scale`.
    """
    middle = keyframe_scale(log_ratio, weights)
    prior = np.eye(ROWS * COLUMNS) / NODE_SD**2 + _steps(ROWS, COLUMNS) / STEP_SD**2
    nodes: Array = np.zeros(ROWS * COLUMNS)
    for _ in range(5):
        residual = (log_ratio - middle - basis @ nodes) / DEPTH_SD
        weighted = basis * (weights / (1 + residual**2))[:, None] / DEPTH_SD**2
        nodes = np.asarray(np.linalg.solve(prior + weighted.T @ basis, weighted.T @ (log_ratio - middle)))
    return middle + nodes.reshape(ROWS, COLUMNS)


def _steps(rows: int, columns: int) -> Array:
    """Sum of outer products of neighbour differences."""
    index = np.arange(rows * columns).reshape(rows, columns)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
        ]
    )
    difference = np.zeros((len(pairs), rows * columns))
    difference[np.arange(len(pairs)), pairs[:, 0]] = 1
    difference[np.arange(len(pairs)), pairs[:, 1]] = -1
    return difference.T @ difference
