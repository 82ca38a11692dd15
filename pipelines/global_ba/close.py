"""Closing loops: a pose graph where there is drift, then bundle adjustment with the loops' own correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config import TrackingConfig
from ..geometry import se3
from ..structure.bundle import reprojection_errors
from ..tracking.adjust import LoadProxy, Report, adjust_state
from ..tracking.state import Sightings, TrackState
from ..types import Intrinsics
from .pose_graph import Edges, optimise_pose_graph
from .verify import Loop

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Closed:
    """The state after closing, how its adjustment went, and the median reprojection error before and after, pixels, of
    the sightings that were there before the loops."""

    state: TrackState
    report: Report
    error_before: float
    error_after: float


def close_loops(
    state: TrackState,
    loops: Sequence[Loop],
    drifted: bool,
    intrinsics: Intrinsics,
    load_proxy: LoadProxy,
    metric: bool,
    tracking: TrackingConfig,
) -> Closed:
    """Adjust `state` (changed in place) with the loops."""
    before = reprojection_error(state, intrinsics)
    original = dict(state.sightings)
    if drifted:
        straighten(state, loops)
    add_sightings(state, loops)
    report = adjust_state(state, intrinsics, load_proxy, metric, tracking)
    after = reprojection_error(state, intrinsics, original)
    return Closed(state, report, before, after)


def reprojection_error(
    state: TrackState, intrinsics: Intrinsics, sightings: dict[int, Sightings] | None = None
) -> float:
    """Median over the sightings (the state's, or those given), in pixels."""
    errors = []
    for frame_id, seen in sorted((sightings or state.sightings).items()):
        in_cam = se3.transform(state.poses[frame_id], state.points[seen.point])
        errors.append(reprojection_errors(in_cam, seen.xy, intrinsics))
    return float(np.median(np.concatenate(errors)))


def add_sightings(state: TrackState, loops: Sequence[Loop]) -> None:
    """Each side of a loop sees the other side's points; a point already seen there keeps its first sighting."""
    for loop in loops:
        for frame_id, extra in ((loop.edge.frame2_id, loop.in_second), (loop.edge.frame1_id, loop.in_first)):
            seen = state.sightings[frame_id]
            state.sightings[frame_id] = seen.joined(extra.select(~np.isin(extra.point, seen.point)))


def straighten(state: TrackState, loops: Sequence[Loop]) -> None:
    """Spread the drift over the keyframes by a pose graph; points move with the first keyframe that sees them."""
    ids = state.keyframes
    place = {frame_id: n for n, frame_id in enumerate(ids)}
    old = np.array([state.poses[i] for i in ids])
    depth = np.array([state.median_depth(i) for i in ids])
    edges = _edges(old, depth, loops, place)
    new, scales = optimise_pose_graph(old, np.ones(len(ids)), edges)
    _move_points(state, ids, old, new, scales)
    for n, frame_id in enumerate(ids):
        rigid = new[n].copy()
        rigid[:3, 3] /= scales[n]
        state.poses[frame_id] = rigid


def _edges(poses: Array, depth: Array, loops: Sequence[Loop], place: dict[int, int]) -> Edges:
    """Each keyframe to the next two, and the loops."""
    n = len(poses)
    chain = [(i, i + step) for step in (1, 2) for i in range(n - step)]
    first = [a for a, _ in chain] + [place[loop.edge.frame1_id] for loop in loops]
    second = [b for _, b in chain] + [place[loop.edge.frame2_id] for loop in loops]
    motions = [poses[b] @ se3.inverse(poses[a]) for a, b in chain]
    # An edge's translation comes in the first keyframe's scale.
    motions += [se3.scaled(loop.edge.frame2_from_frame1, loop.edge.scale) for loop in loops]
    scale = np.concatenate([np.ones(len(chain)), [loop.edge.scale for loop in loops]])
    length = np.array([np.linalg.norm(m[:3, 3]) for m in motions[: len(chain)]])
    sd = np.empty((len(first), 7))
    sd[: len(chain), :3] = (0.02 * length + 0.002 * depth[np.array(first[: len(chain)])])[:, None]
    sd[: len(chain), 3:6] = np.radians(0.2)
    sd[: len(chain), 6] = 0.02
    sd[len(chain) :, :3] = 0.01 * depth[np.array(second[len(chain) :])][:, None]
    sd[len(chain) :, 3:6] = np.radians(0.5)
    sd[len(chain) :, 6] = 0.03
    robust = np.arange(len(first)) >= len(chain)
    return Edges(np.array(first), np.array(second), np.array(motions), scale, sd, robust)


def _move_points(state: TrackState, ids: list[int], old: Array, new: Array, scales: Array) -> None:
    owner = np.full(len(state.points), -1)
    for n in reversed(range(len(ids))):
        owner[state.sightings[ids[n]].point] = n
    for n in range(len(ids)):
        mine = owner == n
        in_cam = state.points[mine] @ old[n, :3, :3].T + old[n, :3, 3]
        state.points[mine] = (in_cam - new[n, :3, 3]) @ new[n, :3, :3] / scales[n]
