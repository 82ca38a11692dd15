"""Conversion of the tracking state to the arrays that the next stages read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..geometry import se3
from ..geometry.sparse_model import SparseModel
from ..types import Frame, Trajectory
from .state import TrackState


def split_worlds(state: TrackState, least: int) -> list[TrackState]:
    """The segments, largest first, each in a world of its own that begins with its first posed camera; of those after
    the first, the ones of at least so many frames. The first has the reason why a frame is in none or in another."""
    counts = state.segment_sizes()
    order = list(counts)
    kept = order[:1] + [s for s in order[1:] if counts[s] >= least]
    elsewhere = {s: f"in piece_{n}, which is not connected to the rest" for n, s in enumerate(kept[1:], 2)}
    short = "tracked, but this stretch could not be joined to the rest"
    apart = {i: elsewhere.get(s, short) for i, s in state.segment.items() if s != order[0]}
    first, *pieces = (_alone(state, segment) for segment in kept)
    return [replace(first, lost=state.lost | apart), *pieces]


def _alone(state: TrackState, segment: int) -> TrackState:
    inside = [i for i in sorted(state.poses) if state.segment[i] == segment]
    new_from_old = state.poses[inside[0]]
    old_from_new = se3.inverse(new_from_old)
    return TrackState(
        state.points @ new_from_old[:3, :3].T + new_from_old[:3, 3],
        state.colors,
        {i: state.poses[i] @ old_from_new for i in inside},
        {i: state.sightings[i] for i in inside},
        [k for k in state.keyframes if state.segment[k] == segment],
        segment=dict.fromkeys(inside, segment),
        rig=state.rig,
        turned=[i for i in state.turned if state.segment[i] == segment],
        shutter=state.shutter,
    )


def to_trajectory(state: TrackState, frames: list[Frame]) -> Trajectory:
    """All frames, posed or with the reason why not."""
    keyframes = set(state.keyframes)
    return Trajectory(
        frame_ids=np.array([f.id for f in frames], np.int64),
        timestamps=np.array([f.timestamp for f in frames]),
        cam_from_world=np.array([state.poses.get(f.id, np.eye(4)) for f in frames]),
        is_keyframe=np.array([f.id in keyframes for f in frames]),
        lost_reasons=tuple("" if f.id in state.poses else state.lost.get(f.id, "not tracked") for f in frames),
        by_rotation=np.isin([f.id for f in frames], state.turned),
    )


def to_sparse_model(state: TrackState) -> SparseModel:
    """Keyframes and the points that at least two of them see."""
    cam, seen = state.shared_sightings(state.keyframes)
    used, renumbered = np.unique(seen.point, return_inverse=True)
    return SparseModel(
        np.array(state.keyframes, np.int64),
        np.array([state.poses[k] for k in state.keyframes]),
        state.points[used],
        state.colors[used],
        cam.astype(np.int64),
        renumbered.astype(np.int64),
        seen.xy,
    )
