"""Scales of proxy depth: a field for each keyframe, chosen so that views and triangulated points agree.

First the points alone give each keyframe a coarse field (`fit_to_points`), then the views give it a finer one together
(`align_keyframes`): the error of a depth is smooth over an image and changes from image to image, so where many images
see the same surface, its true place is near the middle of their depths. A shift is no part of a field: depth that is
known only up to one is given it before (`learned.AlignedDepth`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ..geometry.posed_depth import PosedDepth, neighbours
from ..geometry.sparse_model import SparseModel
from ..providers import DepthEstimate
from ..system.machine import ALIGNED_TOGETHER
from ..system.parallel import LruSequence
from ..types import Intrinsics, ProxyMaps
from .fields import FINE, Basis, DepthFields, Equations, FieldGrid, Prior, solve_fields

Array = NDArray[np.float64]

SAMPLES_ACROSS = 40
"""Along the longer side of a view."""
SIDE = 320
"""Pixels on the long side of the depths that are compared."""
POINT_SD = 0.01
"""Expected disagreement of a view with a triangulated point."""
GROSS = 0.15
"""A larger disagreement is another surface."""
ROUNDS = 4
_ROOM = 60_000_000
"""Bytes of depths, and of samples of them, that are kept; what has no room is read again."""
COARSE = FieldGrid(3, 4)
"""Of the fields that points alone can determine."""
POINTS_PRIOR = Prior(COARSE, node_sd=0.06, step_sd=0.05)
"""Around the keyframe's scale."""
DEPTH_SD = 0.05
"""Relative standard deviation of a reliable proxy depth after its scale is known."""
MIN_RELIABILITY = 0.1
_ROUNDS = 5


@dataclass(frozen=True)
class WorldScale:
    """The factor that makes the world metric, and its relative standard deviation."""

    factor: float
    relative_sd: float


@dataclass(frozen=True)
class FieldModel:
    """The prior of a field around its expected value, the expected disagreement of two views about a surface, and what
    part of an equation a sample is: neighbouring samples may err alike."""

    prior: Prior
    pair_sd: float
    share: float


OF_PROXIES = FieldModel(Prior(FINE, node_sd=0.05, step_sd=0.08), pair_sd=0.03, share=0.25)
"""Around what the keyframe's own points say."""


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
    return WorldScale(float(np.exp(-mean)), float(used.std() / np.sqrt(max(independent, 1.0))))


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
        fields = solve_fields([points], fields, expected, POINTS_PRIOR)
    return fields


def as_fine(field: Array) -> Array:
    """(nodes of FINE,) a field of COARSE."""
    return COARSE.finer(field, FINE)


@dataclass(frozen=True)
class Anchors:
    """Points of one view whose depth is known: xy (P, 2) in its pixels, depth (P,) and its relative error sd (P,)."""

    xy: Array
    depth: Array
    sd: Array

    def and_also(self, others: Anchors) -> Anchors:
        """Join two sets of points of the view."""
        pairs = ((self.xy, others.xy), (self.depth, others.depth), (self.sd, others.sd))
        return Anchors(*(np.concatenate(pair) for pair in pairs))


def align_keyframes(
    model: SparseModel,
    intrinsics: Intrinsics,
    load_maps: Callable[[int], ProxyMaps | None],
    expected: Mapping[int, Array],
) -> DepthFields:
    """The fields of the model's keyframes that have maps.

    `expected`: by frame id, log scales at FINE's nodes (108,) as the keyframe's own points alone give them; a keyframe
    without takes the middle of the others.
    """

    def view_of(row: int) -> PosedDepth:
        maps = load_maps(int(model.frame_ids[row]))
        assert maps is not None, "there was one before"
        return posed_small(maps, intrinsics, model.cam_from_world[row])

    rows: list[int] = []
    anchors: dict[int, Anchors] = {}
    for k, frame_id in enumerate(model.frame_ids.tolist()):
        maps = load_maps(frame_id)
        if maps is not None and (maps.depth > 0).any():
            camera = posed_small(maps, intrinsics, model.cam_from_world[k]).intrinsics
            anchors[len(rows)] = keyframe_anchors(model, k, intrinsics, camera)
            rows.append(k)
    ids = [int(model.frame_ids[k]) for k in rows]
    views = kept_views(len(rows), lambda n: view_of(rows[n]))
    middle = float(np.median([np.median(e) for e in expected.values()])) if expected else 0.0
    start = np.array([expected.get(i, np.full(FINE.size, middle)) for i in ids]).reshape(len(ids), FINE.size)
    fields = fit_fields(views, anchors, start)
    return DepthFields({i: f.reshape(FINE.rows, FINE.columns) for i, f in zip(ids, fields, strict=True)})


def kept_views(count: int, make: Callable[[int], PosedDepth]) -> Sequence[PosedDepth]:
    """Keep as many views as there is room for; make the others again when they are asked for."""
    return LruSequence(count, make, lambda v: v.depth.nbytes + v.trust.nbytes, _ROOM)


def posed_small(maps: ProxyMaps | DepthEstimate, intrinsics: Intrinsics, cam_from_world: Array) -> PosedDepth:
    """Depths at the size that is compared."""
    stride = max(round(max(maps.depth.shape) / SIDE), 1)
    strided = (slice(stride // 2, None, stride),) * 2
    depth, trust = maps.depth[strided].copy(), maps.confidence[strided].copy()
    height, width = maps.depth.shape
    return PosedDepth(intrinsics.resized(width, height).every(stride), cam_from_world, depth, trust * (depth > 0))


def keyframe_anchors(model: SparseModel, k: int, full: Intrinsics, small: Intrinsics) -> Anchors:
    """The model's points in the pixels of the k-th keyframe that sees them."""
    mine = model.observations_of(k)
    points = model.points_in_world[model.obs_point[mine]]
    depth = points @ model.cam_from_world[k, 2, :3] + model.cam_from_world[k, 2, 3]
    (fx, fy, cx, cy), (small_fx, small_fy, small_cx, small_cy) = full.numbers, small.numbers
    rays = (model.obs_xy[mine] - [cx, cy]) / [fx, fy]
    return Anchors(rays * [small_fx, small_fy] + [small_cx, small_cy], depth, np.full(len(depth), POINT_SD))


def fit_fields(
    views: Sequence[PosedDepth],
    anchors: Mapping[int, Anchors],
    expected: Array | None = None,
    how: FieldModel = OF_PROXIES,
) -> Array:
    """(N, nodes) log scales by robust least squares, re-linearised at every round; `anchors` by index of the view. Of a
    long recording a window of views at a time, the others unchanged."""
    size = how.prior.grid.size
    start = np.zeros((len(views), size)) if expected is None else expected
    fields = start.copy()
    samples = LruSequence(len(views), lambda n: _Samples.of(views[n], how.prior.grid), lambda s: s.nbytes, _ROOM)
    near = neighbours(views)
    windows = np.array_split(np.arange(len(views)), -(-len(views) // ALIGNED_TOGETHER)) if len(views) else []
    for window in windows * ROUNDS:
        first, last = int(window[0]), int(window[-1])
        points = (_point_equations(n, views[n], anchors[n], fields, how) for n in window.tolist() if n in anchors)
        touching = [(i, j) for i, j in near if first <= i <= last or first <= j <= last]
        pairs = (_pair_equations(i, j, samples[i], views[j], fields, how) for i, j in touching)
        own = range(first * size, (last + 1) * size)
        parts = (equations.within(own) for equations in chain(points, pairs))
        fields[window] = solve_fields(parts, fields[window], start[window], how.prior)
    return fields


@dataclass(frozen=True)
class _Samples:
    """A grid of pixels with depth: depth, trust (S,), rays (S, 3) in the world, center (3,)."""

    depth: Array
    trust: Array
    rays: Array
    center: Array
    basis: Basis

    @property
    def nbytes(self) -> int:
        """Memory they take."""
        return sum(a.nbytes for a in (self.depth, self.trust, self.rays, self.basis.nodes, self.basis.weights))

    @staticmethod
    def of(view: PosedDepth, grid: FieldGrid) -> _Samples:
        xy, depth, trust = view.grid(SAMPLES_ACROSS)
        use = trust > 0.1
        center: Array = np.asarray(np.linalg.inv(view.cam_from_world)[:3, 3], np.float64)
        rays = view.in_world(xy[use], np.ones(int(use.sum()))) - center
        basis = grid.at(xy[use], view.intrinsics.width, view.intrinsics.height)
        return _Samples(depth[use], trust[use], rays, center, basis)


def _pair_equations(i: int, j: int, samples: _Samples, other: PosedDepth, fields: Array, how: FieldModel) -> Equations:
    """Samples of view i carried into view j: their depth there against what view j says."""
    depth = samples.depth * np.exp(samples.basis.of(fields[i]))
    along = samples.rays @ other.cam_from_world[2, :3] * depth
    xy, z, inside = other.seen(samples.center + samples.rays * depth[:, None])
    place = np.where(inside[:, None], xy, 0).astype(int)
    seen = other.depth[place[:, 1], place[:, 0]].astype(np.float64)
    trust = other.trust[place[:, 1], place[:, 0]].astype(np.float64) * samples.trust
    use = inside & (seen > 0) & (z > 0) & (trust > 0.05)
    grid = how.prior.grid
    there = grid.at(place[use] + 0.5, other.intrinsics.width, other.intrinsics.height)
    residual = np.log(z[use]) - np.log(seen[use]) - there.of(fields[j])
    near = np.abs(residual) < GROSS
    # A point moves along its ray: how much of that is depth in the other view.
    slope = (along[use] / z[use])[near]
    here, there = samples.basis[use][near], there[near]
    weights = np.concatenate([here.weights * slope[:, None], -there.weights], axis=1)
    columns = np.concatenate([here.nodes + i * grid.size, there.nodes + j * grid.size], axis=1)
    return Equations(columns, weights, residual[near], how.pair_sd / np.sqrt(trust[use][near]), how.share)


def _point_equations(n: int, view: PosedDepth, anchors: Anchors, fields: Array, how: FieldModel) -> Equations:
    """The view's depth at points of known depth."""
    width, height = view.intrinsics.width, view.intrinsics.height
    inside = ((anchors.xy >= 0) & (anchors.xy < (width, height))).all(1)
    xy, truth, expected = anchors.xy[inside], anchors.depth[inside], anchors.sd[inside]
    place = xy.astype(int)
    seen = view.depth[place[:, 1], place[:, 0]].astype(np.float64)
    trust = view.trust[place[:, 1], place[:, 0]].astype(np.float64)
    use = (seen > 0) & (truth > 0) & (trust > 0.05)
    basis = how.prior.grid.at(xy[use], width, height)
    residual = np.log(seen[use]) + basis.of(fields[n]) - np.log(truth[use])
    near = np.abs(residual) < 2 * GROSS
    sd = expected[use][near] / np.sqrt(trust[use][near])
    return Equations.of_places(n, basis[near], how.prior.grid.size, residual[near], sd, how.share)
