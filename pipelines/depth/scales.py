"""Scales of proxy depth against triangulated points: a scale or coarse field per keyframe, one scale for the world.

A shift is no part of a field: depth that is known only up to one is given it before (`pipelines.proxy.aligned`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics, ProxyMaps
from .fields import FINE, Basis, Grid
from .solve import Equations, Prior, solve_fields

Array = NDArray[np.float64]

COARSE = Grid(3, 4)
"""Of the fields that points alone can determine."""
PRIOR = Prior(COARSE, node_sd=0.06, step_sd=0.05)
"""Around the keyframe's scale."""
DEPTH_SD = 0.05
"""Relative standard deviation of a reliable proxy depth after its scale is known."""
MIN_RELIABILITY = 0.1
_ROUNDS = 5


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


def scale_at_points(maps: ProxyMaps, xy: Array, z: Array, intrinsics: Intrinsics, least: int) -> float | None:
    """World over proxy depth: the median over points at pixels (Q, 2) and depths (Q,) of the world; None for fewer than
    `least`."""
    known, trust = sample_proxy(maps, xy, intrinsics)
    both = (known > 0) & (z > 0)
    if both.sum() < least:
        return None
    return float(np.exp(keyframe_scale(np.log(z[both] / known[both]), trust[both])))


def world_scale(log_scales: Array) -> WorldScale:
    """The factor on the world that makes the keyframes' proxies right on average, from their log scales (N,).

    The mean without those beyond three robust sigmas. The uncertainty counts only independent keyframes: errors of
    neighbours are alike, which the correlation of successive ones shows.
    """
    deviation = log_scales - np.median(log_scales)
    sigma = 1.4826 * float(np.median(np.abs(deviation)))
    used = log_scales[np.abs(deviation) <= 3 * max(sigma, 1e-6)]
    mean, n = float(used.mean()), len(used)
    rest = used - mean
    correlation = float(rest[1:] @ rest[:-1] / max(float(rest @ rest), 1e-12)) if n > 2 else 0.0
    independent = max(n * (1 - correlation) / (1 + correlation), 1.0) if correlation > 0 else n
    return WorldScale(float(np.exp(-mean)), float(used.std() / np.sqrt(max(independent, 1.0))), n)


def fit_to_points(field: NDArray[np.int64], basis: Basis, log_ratio: Array, weights: Array, middles: Array) -> Array:
    """(N, nodes of COARSE) log scales: robust, smooth, near the keyframes' `middles` (N,) where there are few points.

    field (Q,): whose point it is; basis: where, in COARSE; log_ratio (Q,) and weights (Q,) as for `keyframe_scale`.
    """
    expected = np.repeat(middles[:, None], COARSE.size, axis=1)
    fields = expected
    sd = DEPTH_SD / np.sqrt(np.maximum(weights, 1e-6))
    for _ in range(_ROUNDS if len(fields) else 0):
        residual = basis.of(fields[field]) - log_ratio
        points = Equations.of_places(field, basis, COARSE.size, residual, sd, 1.0)
        fields = solve_fields([points], fields, expected, PRIOR)
    return fields


def as_fine(field: Array) -> Array:
    """(nodes of FINE,) a field of COARSE."""
    return COARSE.finer(field, FINE)
