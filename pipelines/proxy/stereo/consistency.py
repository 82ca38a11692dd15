"""Do the depths of several views agree? Their support is the confidence, their mean the better depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.proxy.stereo.bands import Bands
from msgs_slam.pipelines.system.jit import kernel


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

    def work(first: int, last: int) -> None:
        _fuse_band(depth, others, warps, back_rows, tolerance, first, last, fused, support, conflict)

    bands.run(depth.shape[0], work)
    return fused, support, conflict


@kernel
def _sample(depth: NDArray[np.float32], px: float, py: float, tolerance: float) -> float:
    """Inverse-depth interpolation where the four neighbours lie on one surface, else the nearest pixel's depth."""
    height, width = depth.shape
    nearest = depth[min(max(int(py + 0.5), 0), height - 1), min(max(int(px + 0.5), 0), width - 1)]
    ix = int(np.floor(px))
    iy = int(np.floor(py))
    if ix < 0 or iy < 0 or ix + 1 >= width or iy + 1 >= height:
        return nearest
    a, b, c, d = depth[iy, ix], depth[iy, ix + 1], depth[iy + 1, ix], depth[iy + 1, ix + 1]
    low = min(min(a, b), min(c, d))
    high = max(max(a, b), max(c, d))
    if low <= 0 or high - low > 3 * tolerance * low:
        return nearest
    fx = px - ix
    fy = py - iy
    inverse = (1 - fy) * ((1 - fx) / a + fx / b) + fy * ((1 - fx) / c + fx / d)
    return 1 / inverse


@kernel
def _fuse_band(
    depth: NDArray[np.float32],
    others: NDArray[np.float32],
    warps: NDArray[np.float64],
    back_rows: NDArray[np.float64],
    tolerance: float,
    first: int,
    last: int,
    fused: NDArray[np.float32],
    support: NDArray[np.float32],
    conflict: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    for y in range(first, last):
        for x in range(width):
            z = depth[y, x]
            weights = 1.0
            total = 0.0
            against = 0.0
            if z > 0:
                total = 1.0 / z
                for n in range(others.shape[0]):
                    w = warps[n]
                    u, v = x + 0.5, y + 0.5
                    qx = z * (w[0, 0] * u + w[0, 1] * v + w[0, 2]) + w[0, 3]
                    qy = z * (w[1, 0] * u + w[1, 1] * v + w[1, 2]) + w[1, 3]
                    qz = z * (w[2, 0] * u + w[2, 1] * v + w[2, 2]) + w[2, 3]
                    if qz <= 0:
                        continue
                    ou, ov = qx / qz, qy / qz
                    if ou < 0 or ov < 0 or ou >= width or ov >= height:
                        continue
                    seen = _sample(others[n], ou - 0.5, ov - 0.5, tolerance)
                    if seen <= 0:
                        continue
                    difference = (seen - qz) / qz
                    if difference > 4 * tolerance:
                        against += 1.0
                    elif abs(difference) < 3 * tolerance:
                        b = back_rows[n]
                        back = seen * (b[0] * ou + b[1] * ov + b[2]) + b[3]
                        if back > 0:
                            weight = np.exp(-0.5 * (difference / tolerance) ** 2)
                            weights += weight
                            total += weight / back
            fused[y, x] = weights / total if total > 0 else 0.0
            support[y, x] = weights - 1.0
            conflict[y, x] = against
