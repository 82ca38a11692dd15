"""Do the depths of several views agree? Their support is the confidence, their mean the better depth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.camera import project
from ...geometry.sparse_model import SparseModel
from ...system.lanes import any_lane, iota, lane_exp, load, maximum, min_scalar, splat, store, where
from ...system.threads import fused_kernel, inner
from ...types import Intrinsics
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
    """Sample a flat depth map: interpolated within one surface, else the nearest pixel."""
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
            if not any_lane(z > _ZERO):
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
                if not any_lane(shown):
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
                weight = where(agrees, lane_exp(off * off * -_HALF))
                weights, total = weights + weight, total + weight / choose(agrees, back, splat(_ONE))
            store(rows[1], x, where(known, weights / total))
            store(rows[2], x, weights - _ONE)
            store(rows[3], x, against)
        fused[y], support[y], conflict[y] = rows[1, :width], rows[2, :width], rows[3, :width]


_MAX_POINTS = 400
_UNSEEN_WEIGHT = 0.3
"""Weight of a point that should be in the other view but was not matched there: it may be hidden."""
_NEAR_MARGIN, _FAR_MARGIN = 0.45, 1.5
"""What is plain has no points: a near sofa may stand well before the nearest of them, and beyond the range nothing can
be found."""
_MIN_POINTS = 12
_MAX_CANDIDATES = 128
"""So many that share points, and so many of the nearest, are compared: a longer recording has no better ones."""


def choose_neighbours(
    model: SparseModel, intrinsics: Intrinsics, index: int, count: int, best_angle: float
) -> NDArray[np.int64]:
    """Choose the keyframes to match one with: their indices, best first.

    A view is good when it sees the same points under an angle near the best (as in MVSNet, Yao et al., ECCV 2018), and
    when it does not repeat a view already chosen.

    Args:
        model: the sparse model of structure from motion.
        intrinsics: of the camera that the observations are of.
        index: of the keyframe.
        count: most views to choose.
        best_angle: degrees between the rays to a point.
    """
    points, ids = _points_of(model, index)
    if len(points) == 0 or len(model.frame_ids) < 2:
        return np.empty(0, np.int64)
    others = _candidates(model, index)
    centers = model.centers[others]
    center = model.centers[index]
    scores = np.array([_pair_score(model, intrinsics, points, ids, center, j, best_angle) for j in others.tolist()])
    chosen: list[int] = []
    for _ in range(min(count, len(others))):
        best = int(scores.argmax())
        if scores[best] < 0.02 * min(len(points), _MAX_POINTS):
            break
        chosen.append(int(others[best]))
        reach = 0.35 * np.linalg.norm(centers[best] - center) + 1e-12
        similarity = np.exp(-0.5 * (np.linalg.norm(centers - centers[best], axis=1) / reach) ** 2)
        scores *= 1 - 0.9 * similarity
        scores[best] = 0
    return np.array(chosen, np.int64)


def _candidates(model: SparseModel, index: int) -> NDArray[np.int64]:
    """Sorted indices of the keyframes worth a look: those that share most points, and the nearest ones."""
    shared = np.asarray(model.seen_by[model.points_of(index)].sum(0)).ravel()
    sharing = np.argsort(-shared, kind="stable")[:_MAX_CANDIDATES]
    nearest = model.tree.query(model.centers[index], min(_MAX_CANDIDATES, len(model.frame_ids)))[1]
    found = np.union1d(sharing[shared[sharing] > 0], nearest)
    return found[found != index]


def sweep_range(model: SparseModel, index: int, companions: NDArray[np.int64]) -> tuple[float, float] | None:
    """(near, far) that hold the depths of keyframe `index`, with a margin; None with too few points to say.

    Points of the companion views that lie in front count as well: a keyframe may have few of its own.
    """
    depths = []
    for j in (index, *companions.tolist()):
        points, _ = _points_of(model, j, everything=True)
        z = points @ model.cam_from_world[index, 2, :3] + model.cam_from_world[index, 2, 3]
        depths.append(z[z > 0])
    own = depths[0]
    every = np.concatenate(depths)
    if len(every) < _MIN_POINTS:
        return None
    trusted = own if len(own) >= 4 * _MIN_POINTS else every
    near, far = np.percentile(trusted, [1, 99])
    # Companions may look at what lies behind a corner; let them widen the range, but not without bound.
    near = min(near, max(float(np.percentile(every, 2)), 0.5 * near))
    far = max(far, min(float(np.percentile(every, 98)), 2.0 * far))
    return float(near * _NEAR_MARGIN), float(far * _FAR_MARGIN)


def _points_of(
    model: SparseModel, index: int, everything: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points a keyframe observes and their ids, an even sample of them unless `everything`."""
    ids = model.points_of(index)
    if not everything and len(ids) > _MAX_POINTS:
        ids = ids[np.linspace(0, len(ids) - 1, _MAX_POINTS).astype(np.int64)]
    return model.points_in_world[ids], ids


def _pair_score(
    model: SparseModel,
    intrinsics: Intrinsics,
    points: NDArray[np.float64],
    ids: NDArray[np.int64],
    center: NDArray[np.float64],
    other: int,
    best_angle: float,
) -> float:
    other_from_world = model.cam_from_world[other]
    xy, z = project(points @ other_from_world[:3, :3].T + other_from_world[:3, 3], intrinsics)
    inside = (z > 0) & (xy > 0).all(1) & (xy < [intrinsics.width, intrinsics.height]).all(1)
    if not inside.any():
        return 0.0
    a, b = points - center, points - model.centers[other]
    cosine = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    spread = np.where(angle < best_angle, 0.4 * best_angle, 1.5 * best_angle)
    weight = np.exp(-0.5 * ((angle - best_angle) / spread) ** 2)
    seen = np.isin(ids, model.points_of(other), assume_unique=True)
    return float((inside * weight * np.where(seen, 1.0, _UNSEEN_WEIGHT)).sum())
