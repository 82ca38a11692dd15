"""The adjustment of everything tracked: poses, points and the scale fields of the proxy depths, in turn."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..depth import align as scales
from ..depth.align import COARSE, WorldScale, align_keyframes
from ..depth.fields import DepthFields
from ..geometry import se3
from ..geometry.camera import project
from ..geometry.sparse_model import SparseModel
from ..sfm.bundle import Bundle, adjust_bundle, adjust_pose
from ..sfm.components import undetermined_cameras
from ..sfm.rolling import rectified_bundle, rectified_pixels, velocities
from ..types import Array, Intrinsics, ProxyMaps, rows_by
from .pnp import MAX_GAP
from .state import Sightings, TrackState, sync_rig_poses

LoadProxy = Callable[[int], ProxyMaps | None]
OUTLIER_SD = 4.0
MAX_FRAMES = 400
"""Up to so many frames are adjusted together; of more only the keyframes."""
_FITTED_TOGETHER = 500
"""Keyframes whose fields are fitted at once: by memory alone."""
ROUNDS = 3
ITERATIONS = 20
"""Of each round's bundle adjustment."""


@dataclass
class DepthTies:
    """Proxy depths at the observations of a bundle, and the log scale fields (N, nodes of COARSE) of its
    cameras.

    depth (O,) as the provider gave it, 0 = none; reliability (O,); has_depth (N,) bool; `factor` is what the world has
    been scaled by so far.
    """

    depth: Array
    reliability: Array
    has_depth: NDArray[np.bool_]
    fields: Array
    metric: bool
    world: WorldScale | None = None
    factor: float = 1.0


@dataclass(frozen=True)
class Report:
    """Results of the adjustment: figures for the stage's, and the bundle of these frames with the depths that count."""

    figures: dict[str, Any]
    frame_ids: list[int]
    ties: DepthTies
    bundle: Bundle


def has_independent_depth(proxy_report: Mapping[str, Any]) -> bool:
    """Return whether depth adds to the poses: proxies made from the same images say nothing new about them."""
    return bool(proxy_report.get("independent_depth", proxy_report.get("metric", False)))


def adjust_state(
    state: TrackState, intrinsics: Intrinsics, load_proxy: LoadProxy, metric: bool, use_depth: bool
) -> Report:
    """Adjust `state` in place: rounds of scale fields, removal of outliers and bundle adjustment.

    With more than MAX_FRAMES only keyframes and points are adjusted together, and every other
    frame follows by itself: the cost grows with the number of keyframes, not of frames.
    """
    frame_ids = sorted(state.poses) if len(state.poses) <= MAX_FRAMES else list(state.keyframes)
    bundle = make_bundle(state, frame_ids)
    ties = sample_depths(bundle, frame_ids, state, intrinsics, load_proxy, metric)
    initial, in_frame = None, bundle.obs_xy
    for round_number in range(ROUNDS):
        bundle = undo_rolling_shutter(set_scale(bundle, ties, intrinsics), in_frame, frame_ids, state, intrinsics)
        # At first, links between joined segments are far off and right; what was followed into a neighbour is not.
        keep = consistent(bundle, intrinsics, bundle.obs_source >= (0 if round_number == 0 else -1))
        bundle, in_frame = bundle.select(keep), in_frame[keep]
        ties.depth, ties.reliability = ties.depth[keep], ties.reliability[keep]
        tied = with_depths(bundle, ties, intrinsics, use_depth)
        result = adjust_bundle(tied, intrinsics, ITERATIONS, ids=np.array(frame_ids), rig=state.rig)
        initial = result.initial_cost if initial is None else initial
        bundle = result.bundle
    bundle = set_scale(bundle, ties, intrinsics)
    errors = bundle.reprojection_errors(intrinsics)
    seen = np.isfinite(errors)  # not so of points that the last round has left behind a camera
    write_back(state, bundle, frame_ids)
    follow_others(state, intrinsics, set(frame_ids), ties.factor)
    sync_rig_poses(state)
    figures = {
        "adjusted_frames": len(frame_ids),
        "points": len(np.unique(bundle.obs_point)),
        "observations": len(bundle.obs_cam),
        "reprojection_px": float(np.sqrt(np.mean(errors[seen] ** 2))) if seen.any() else None,
        "behind_camera": int((~seen).sum()),
        "cost_before": initial,
        "cost_after": result.cost,
    }
    return Report(figures, frame_ids, ties, with_depths(bundle, ties, intrinsics, use_depth))


def part_loose(state: TrackState, report: Report, intrinsics: Intrinsics, least: int) -> None:
    """Part, in place, what neither images nor metric depths determine against the rest of its segment
    (`undetermined_cameras`): groups of at least `least` keyframes become segments of their own, for nobody knows their
    scale beside the rest; the frames of smaller ones are lost.

    Frames that were not adjusted themselves go with the nearest keyframe. One or two between others stay.
    """
    ids = report.frame_ids
    if len(state.rig) > 1:  # a panorama sees all around
        return
    segments: dict[int, list[int]] = {}
    for k in np.unique(report.bundle.obs_cam).tolist():
        segments.setdefault(state.segment[ids[k]], []).append(k)
    keyframes = set(state.keyframes)
    counted = {k for k, i in enumerate(ids) if i in keyframes}
    found, apart = undetermined_cameras(report.bundle, intrinsics, segments.values(), least, counted)
    loose = {ids[k] for k in found}
    others = sorted(set(state.poses).difference(ids))
    loose |= {i for i in others if state.nearest_keyframes(i, 1)[0] in loose}
    held = np.array(sorted(set(state.poses).difference(loose)), np.int64)
    # What holds before and behind a frame or two tells where they are about.
    loose -= {i for a, b in pairwise(held.tolist()) if b - a <= MAX_GAP for i in range(a + 1, b)}
    for i in sorted(loose):
        state.remove_frame(i)
        state.lost[i] = "what it shows does not determine its pose relative to the rest"
    for group in apart:
        inside = {ids[k] for k in group}
        following = {i for i in others if i in state.poses and state.nearest_keyframes(i, 1)[0] in inside}
        state.detach(inside | following)


def undo_rolling_shutter(
    bundle: Bundle, in_frame: Array, frame_ids: list[int], state: TrackState, intrinsics: Intrinsics
) -> Bundle:
    """Return the bundle with its pixels in the frames (O, 2), less what a rolling shutter adds."""
    shutter = state.shutter
    if not shutter.is_rolling:
        return bundle
    worlds = np.array([state.segment[i] for i in frame_ids])
    velocity = velocities(bundle.cam_from_world, shutter.times[frame_ids], worlds)
    return rectified_bundle(bundle, in_frame, intrinsics, velocity, shutter.readout)


def align_depths(model: SparseModel, report: Report, intrinsics: Intrinsics, load_proxy: LoadProxy) -> DepthFields:
    """Fit the depth fields of all keyframes in the world of `model`, which the reported adjustment has made."""
    ties = report.ties
    known = {i: scales.as_fine(ties.fields[c]) for c, i in enumerate(report.frame_ids) if ties.has_depth[c]}
    return align_keyframes(model, intrinsics, load_proxy, known)


def make_bundle(state: TrackState, frame_ids: list[int]) -> Bundle:
    """Bundle all sightings of the given frames, in their order; points seen only once are left out."""
    cam, seen = state.shared_sightings(frame_ids)
    poses, zeros = np.array([state.poses[i] for i in frame_ids]), np.zeros(len(seen))
    # The last one stands for those of no source.
    number = np.full(max(max(frame_ids), int(seen.source.max(initial=-1))) + 2, -1)
    number[frame_ids] = np.arange(len(frame_ids))
    return Bundle(
        poses, state.points.copy(), cam, seen.point, seen.xy, seen.sd, zeros, zeros + 1, number[seen.source]
    )  # fmt: skip


def sample_depths(
    bundle: Bundle, frame_ids: list[int], state: TrackState, intrinsics: Intrinsics, load_proxy: LoadProxy, metric: bool
) -> DepthTies:
    """Proxy depths of the keyframes at the bundle's observations."""
    depth, reliability = np.zeros(len(bundle.obs_cam)), np.zeros(len(bundle.obs_cam))
    has_depth = np.zeros(len(frame_ids), bool)
    keyframes = set(state.keyframes)
    for c, (frame_id, mine) in enumerate(zip(frame_ids, rows_by(bundle.obs_cam, len(frame_ids)), strict=True)):
        maps = load_proxy(frame_id) if frame_id in keyframes else None
        if maps is None:
            continue
        depth[mine], reliability[mine] = scales.sample_proxy(maps, bundle.obs_xy[mine], intrinsics)
        has_depth[c] = bool((depth[mine] > 0).sum() >= 5)
    fields = np.zeros((len(frame_ids), COARSE.size))
    return DepthTies(depth, reliability, has_depth, fields, metric)


def set_scale(bundle: Bundle, ties: DepthTies, intrinsics: Intrinsics) -> Bundle:
    """Fit the fields; when the proxies are metric, scale the world so that they are right on average."""
    z = bundle.points_in_cam()[:, 2]
    usable = (ties.depth > 0) & (z > 0)
    log_ratio = np.where(usable, np.log(np.where(usable, z, 1) / np.where(usable, ties.depth, 1)), 0.0)
    middles = np.zeros(len(ties.fields))
    for c, rows in enumerate(rows_by(bundle.obs_cam, len(middles))):
        mine = rows[usable[rows]] if ties.has_depth[c] else rows[:0]
        middles[c] = scales.keyframe_scale(log_ratio[mine], ties.reliability[mine])
    fields, usable = [], usable & ties.has_depth[bundle.obs_cam]
    for first in range(0, max(len(middles), 1), _FITTED_TOGETHER):  # no field knows of another one
        own = slice(first, first + _FITTED_TOGETHER)
        used = np.flatnonzero(usable & (bundle.obs_cam >= own.start) & (bundle.obs_cam < own.stop))
        basis = COARSE.at(bundle.obs_xy[used], intrinsics.width, intrinsics.height)
        known = log_ratio[used], ties.reliability[used], middles[own]
        fields.append(scales.fit_to_points(bundle.obs_cam[used] - first, basis, *known))
    ties.fields = np.concatenate(fields)
    if not (ties.metric and ties.has_depth.any()):
        return bundle
    ties.world = scales.world_scale(middles[ties.has_depth])
    factor = ties.world.factor
    ties.factor *= factor
    ties.fields[ties.has_depth] += np.log(factor)
    return replace(bundle, cam_from_world=se3.scaled(bundle.cam_from_world, factor), points=bundle.points * factor)


def with_depths(bundle: Bundle, ties: DepthTies, intrinsics: Intrinsics, use_depth: bool) -> Bundle:
    """Return the bundle with the rescaled proxy depths as its depth observations.

    Proxies that were made from the same images say nothing new about the poses: without metres, or with
    `use_depth` off, they are left out.
    """
    if not (use_depth and ties.metric):
        return bundle
    log_scale = COARSE.at(bundle.obs_xy, intrinsics.width, intrinsics.height).of(ties.fields[bundle.obs_cam])
    trusted = (ties.depth > 0) & ties.has_depth[bundle.obs_cam]
    sd = scales.DEPTH_SD / np.sqrt(np.maximum(ties.reliability, scales.MIN_RELIABILITY))
    return replace(bundle, obs_depth=np.where(trusted, ties.depth * np.exp(log_scale), 0.0), obs_depth_sd=sd)


def consistent(bundle: Bundle, intrinsics: Intrinsics, judged: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(O,) observations to keep: no outliers among those `judged`, nothing followed from one, over however many frames,
    and of points that at least two cameras still see."""
    errors, source = bundle.errors(intrinsics), bundle.source_rows()
    # 1.1774: the median of a Rayleigh variable of sigma 1.
    sigma = max(float(np.median(errors[judged])) / 1.1774, 0.5) if judged.any() else 0.5
    keep = (errors < OUTLIER_SD * sigma) | ~judged
    before = np.zeros_like(keep)
    while (before != keep).any():
        before = keep
        keep = keep & ((bundle.obs_source < 0) | (keep[source] & (source >= 0)))
    keep &= np.bincount(bundle.obs_point[keep], minlength=len(bundle.points))[bundle.obs_point] >= 2
    return keep


def write_back(state: TrackState, bundle: Bundle, frame_ids: list[int]) -> None:
    """Poses, points and the sightings that are left, into the state; points nobody sees stay unused."""
    state.points = bundle.points
    for c, (frame_id, mine) in enumerate(zip(frame_ids, rows_by(bundle.obs_cam, len(frame_ids)), strict=True)):
        seen = state.sightings[frame_id]
        state.poses[frame_id] = bundle.cam_from_world[c]
        state.sightings[frame_id] = seen.select(np.isin(seen.point, bundle.obs_point[mine]))


def follow_others(state: TrackState, intrinsics: Intrinsics, adjusted: set[int], factor: float) -> None:
    """Frames outside the adjustment take the world's new scale and settle on the adjusted points they see."""
    alive = np.zeros(len(state.points), bool)
    for frame_id in adjusted:
        alive[state.sightings[frame_id].point] = True
    others = sorted(set(state.poses) - adjusted)
    for frame_id in others:
        state.poses[frame_id] = se3.scaled(state.poses[frame_id], factor)
    velocity = state.velocities() if state.shutter.is_rolling else {}
    for frame_id in others:
        seen = state.sightings[frame_id]
        state.sightings[frame_id] = seen.select(alive[seen.point])
        settle(frame_id, state, intrinsics, velocity)


def settle(frame_id: int, state: TrackState, intrinsics: Intrinsics, velocity: dict[int, Array]) -> None:
    """Settle a frame's pose on the points it sees, in place; of its sightings those stay that are still known.
    velocity: as in `global_shutter_pixels`."""
    seen = state.sightings[frame_id]
    xy = global_shutter_pixels(frame_id, seen, state, intrinsics, velocity)
    xy -= source_errors(seen, state, intrinsics, velocity)
    known = np.asarray(np.isfinite(xy).all(1))
    seen, xy = seen.select(known), xy[known]
    state.sightings[frame_id] = seen
    if len(seen) >= 6:
        points = state.points[seen.point]
        state.poses[frame_id] = adjust_pose(state.poses[frame_id], points, xy, seen.sd, intrinsics)


def source_errors(seen: Sightings, state: TrackState, intrinsics: Intrinsics, velocity: dict[int, Array]) -> Array:
    """(Q, 2) pixels by which the sightings that these were followed from are off, 0 for those found by themselves; NaN
    where they are no longer there."""
    out = np.repeat(np.where(seen.source < 0, 0.0, np.nan)[:, None], 2, axis=1)
    for source in np.unique(seen.source[seen.source >= 0]).tolist():
        mine = np.flatnonzero(seen.source == source)
        _, followed, rows = np.intersect1d(seen.point[mine], state.sightings[source].point, return_indices=True)
        there = state.sightings[source].select(rows)
        modelled, _ = project(se3.transform(state.poses[source], state.points[there.point]), intrinsics)
        out[mine[followed]] = global_shutter_pixels(source, there, state, intrinsics, velocity) - modelled
    return out


def global_shutter_pixels(
    frame_id: int, seen: Sightings, state: TrackState, intrinsics: Intrinsics, velocity: dict[int, Array]
) -> Array:
    """(Q, 2) pixels of a frame's sightings, but for what a rolling shutter adds: velocity by frame, empty for none."""
    if not velocity:
        return seen.xy.copy()
    pose, points = state.poses[frame_id], state.points[seen.point]
    return rectified_pixels(pose, points, seen.xy, intrinsics, velocity[frame_id], state.shutter.readout)
