"""Planes through regions of a picture: in it, the inverse depth of a plane is linear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_PIXELS = 40
"""Of a region that is worth a plane."""
_RESIDUAL = 0.015
"""Relative difference that evidence on a plane has from it."""
_ROUNDS = 8


def region_planes(
    inverse: NDArray[np.float64], weight: NDArray[np.float64], region: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(h, w) inverse depth of the plane through each region's evidence (in a picture, the inverse depth of a plane
    is linear), and the share of the evidence that lies on it; 0 for a region with too little evidence."""
    used = np.flatnonzero(weight.ravel() > 0)
    group = region.ravel()[used]
    return fit_planes(region, group, used, inverse.ravel()[used], weight.ravel()[used])


def fit_planes(
    region: NDArray[np.int64],
    group: NDArray[np.int64],
    used: NDArray[np.int64],
    value: NDArray[np.float64],
    base: NDArray[np.float64],
    quantile: float = 0.5,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(h, w) plane of each region and the share of its evidence on it, from `value`s (Q,) at pixels `used` (Q,) that
    speak for regions `group` (Q,) with weights `base` (Q,).

    quantile: the part of the evidence that lies behind the plane; for a half it is the plane of most of it."""
    height, width = region.shape
    count = int(region.max()) + 1
    flat = region.ravel()
    y, x = np.divmod(np.arange(height * width), width)
    mass = np.maximum(np.bincount(group, base, count), 1e-12)
    center_x = np.bincount(group, base * x[used], count) / mass
    center_y = np.bincount(group, base * y[used], count) / mass

    def design(of: NDArray[np.int64], at: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.stack([(x[at] - center_x[of]) / width, (y[at] - center_y[of]) / width, np.ones(len(at))], -1)

    rows = design(group, used)
    scale = np.maximum(np.bincount(group, base * value, count) / mass, 1e-12) * _RESIDUAL
    robust = np.ones(len(used))
    for _ in range(_ROUNDS if quantile == 0.5 else 2 * _ROUNDS):
        solution = _solve(rows, value, base * robust, group, count)
        residual = (value - (rows * solution[group]).sum(-1)) / scale[group]
        side = np.where(residual > 0, quantile, 1 - quantile)
        robust = 1 / (1 + residual**2) ** 2 if quantile == 0.5 else side / np.maximum(np.abs(residual), 0.3)
    share = np.bincount(group, base * (np.abs(residual) < 2), count) / mass
    enough = np.bincount(group, minlength=count) >= LEAST_PIXELS
    plane = (design(flat, np.arange(height * width)) * solution[flat]).sum(-1)
    return plane.reshape(region.shape), (share * enough)[flat].reshape(region.shape)


def _solve(
    rows: NDArray[np.float64],
    value: NDArray[np.float64],
    weight: NDArray[np.float64],
    group: NDArray[np.int64],
    count: int,
) -> NDArray[np.float64]:
    """(G, 3) weighted least squares of every group; slopes that the evidence does not fix are kept small."""
    normal = np.empty((count, 3, 3))
    right = np.empty((count, 3))
    for i in range(3):
        right[:, i] = np.bincount(group, weight * rows[:, i] * value, count)
        for j in range(3):
            normal[:, i, j] = np.bincount(group, weight * rows[:, i] * rows[:, j], count)
    normal += np.diag([1e-3, 1e-3, 1e-9]) * (normal[:, 2, 2][:, None, None] + 1e-9)
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
