"""Do the depths of several views agree? Their support is the confidence, their mean the better depth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...compute.lanes import any_of, exp, iota, load, maximum, min_scalar, splat, store, where
from ...compute.threads import fused_kernel, inner
from .lane_sampling import choose, corners, smallest
from .volume import Bands

_LANES = 16
_ZERO, _HALF, _ONE, _THREE, _FOUR = (np.float32(x) for x in (0, 0.5, 1, 3, 4))
_RIM = np.float32(1e-3)


def fuse_depths(
    depth: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    back_rows: NDArray[np.float64],
    tolerance: float,
    bands: Bands,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Compare a depth map (H, W) with those of N other views (N, H, W) of the same camera; 0 = unknown.

    `warps` (N, 3, 4) as of `warps_to`; `back_rows` (N, 4) gives the reference's z of (x·z, y·z, z, 1), pixel x, y
    and depth z of the other view. Returns the fused depth (own and agreeing ones, weighted), the support (summed
    weights of agreeing views) and the conflict (number of views that look through the point), each (H, W).
    """
    fused = np.empty_like(depth)
    support = np.empty_like(depth)
    conflict = np.empty_like(depth)

    flat, back, near = warps.astype(np.float32), back_rows.astype(np.float32), np.float32(tolerance)

    def work(first: int, last: int) -> None:
        _fuse_band(depth, others, flat, back, near, first, last, fused, support, conflict)

    bands.run(depth.shape[0], work)
    return fused, support, conflict


@inner
def _sample(depth: NDArray[np.float32], width: int, height: int, px: Any, py: Any, tolerance: np.float32) -> object:
    """Of a flat depth map: inverse-depth interpolation where the four neighbours of the places lie on one surface, else
    the nearest pixel's depth."""
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    whole = (px >= _ZERO) & (py >= _ZERO) & (px < right) & (py < bottom)
    inner_x = min_scalar(maximum(px, splat(_ZERO)), right - _RIM)
    inner_y = min_scalar(maximum(py, splat(_ZERO)), bottom - _RIM)
    a, b, c, d, fx, fy = corners(depth, width, inner_x, inner_y)
    low, high = smallest(smallest(a, b), smallest(c, d)), maximum(maximum(a, b), maximum(c, d))
    whole = whole & (low > _ZERO) & (high - low <= low * (_THREE * tolerance))
    above = splat(_ONE) / a + fx * (splat(_ONE) / b - splat(_ONE) / a)
    below = splat(_ONE) / c + fx * (splat(_ONE) / d - splat(_ONE) / c)
    nearest = choose(fy < _HALF, choose(fx < _HALF, a, b), choose(fx < _HALF, c, d))
    return choose(whole, splat(_ONE) / (above + fy * (below - above)), nearest)


@fused_kernel
def _fuse_band(
    depth: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float32],
    back_rows: NDArray[np.float32],
    tolerance: np.float32,
    first: int,
    last: int,
    fused: NDArray[np.float32],
    support: NDArray[np.float32],
    conflict: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    rows = np.zeros((4, -(-width // _LANES) * _LANES), np.float32)
    for y in range(first, last):
        rows[0, :width] = depth[y]
        for x in range(0, width, _LANES):
            z = load(rows[0], x)
            if not any_of(z > _ZERO):
                for k in range(1, 4):
                    store(rows[k], x, splat(_ZERO))
                continue
            known, u, v = z > _ZERO, iota(np.float32(x) + _HALF), np.float32(y) + _HALF
            weights, total, against = splat(_ONE), choose(known, splat(_ONE) / z, splat(_ONE)), splat(_ZERO)
            for n in range(len(others)):
                w, b = warps[n], back_rows[n]
                qz = z * (u * w[2, 0] + (w[2, 1] * v + w[2, 2])) + w[2, 3]
                shown = known & (qz > _ZERO)
                scale = splat(_ONE) / choose(shown, qz, splat(_ONE))
                ou = (z * (u * w[0, 0] + (w[0, 1] * v + w[0, 2])) + w[0, 3]) * scale
                ov = (z * (u * w[1, 0] + (w[1, 1] * v + w[1, 2])) + w[1, 3]) * scale
                shown = shown & (ou >= _ZERO) & (ov >= _ZERO) & (ou < np.float32(width)) & (ov < np.float32(height))
                if not any_of(shown):
                    continue
                # Elsewhere the place may be anything, and what is read there does not count.
                ou, ov = where(shown, ou), where(shown, ov)
                seen = _sample(others[n].reshape(-1), width, height, ou - _HALF, ov - _HALF, tolerance)
                shown = shown & (seen > _ZERO)
                off = (seen - qz) * scale
                against = against + where(shown & (off > _FOUR * tolerance), splat(_ONE))
                back = seen * (ou * b[0] + ov * b[1] + b[2]) + b[3]
                agrees = shown & (maximum(off, splat(_ZERO) - off) < _THREE * tolerance) & (back > _ZERO)
                off = where(agrees, off * (_ONE / tolerance))
                weight = where(agrees, exp(off * off * -_HALF))
                weights, total = weights + weight, total + weight / choose(agrees, back, splat(_ONE))
            store(rows[1], x, where(known, weights / total))
            store(rows[2], x, weights - _ONE)
            store(rows[3], x, against)
        fused[y], support[y], conflict[y] = rows[1, :width], rows[2, :width], rows[3, :width]
