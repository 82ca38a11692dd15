"""From the tracking state to what the next stages read."""

from __future__ import annotations

from collections import Counter

import numpy as np

from pipelines.geometry import se3
from pipelines.tracking.state import TrackState
from pipelines.types import Frame, SparseModel, Trajectory


def keep_largest_segment(state: TrackState) -> None:
    """Frames of the other segments become lost: their poses live in another world."""
    counts = Counter(state.segment[i] for i in state.poses)
    # The smaller number wins a tie, so that the choice does not depend on the order of a dictionary.
    largest = min(counts, key=lambda s: (-counts[s], s))
    for frame_id in sorted(state.poses):
        if state.segment[frame_id] != largest:
            state.lost.setdefault(frame_id, "tracked, but this stretch could not be joined to the rest")
            for table in (state.poses, state.sightings, state.segment):
                del table[frame_id]
    state.keyframes = [k for k in state.keyframes if k in state.poses]


def take_pieces(state: TrackState, least: int) -> list[TrackState]:
    """The segments but the largest that have at least so many frames, largest first, each in a world of its own."""
    counts = Counter(state.segment.values())
    order = sorted(counts, key=lambda s: (-counts[s], s))[1:]
    pieces = []
    for number, segment in enumerate((s for s in order if counts[s] >= least), 2):
        inside = [i for i in sorted(state.poses) if state.segment[i] == segment]
        poses, sightings = {i: state.poses[i] for i in inside}, {i: state.sightings[i] for i in inside}
        keyframes = [k for k in state.keyframes if k in poses]
        piece = TrackState(state.points, state.colors, poses, sightings, keyframes, segment=dict.fromkeys(inside, 0))
        normalise(piece)
        pieces.append(piece)
        state.lost |= dict.fromkeys(inside, f"in piece_{number}, which nothing joins to the rest")
    return pieces


def normalise(state: TrackState) -> None:
    """Keep one world, the first posed camera its origin."""
    keep_largest_segment(state)
    new_from_old = state.poses[min(state.poses)]
    old_from_new = se3.inverse(new_from_old)
    state.points = state.points @ new_from_old[:3, :3].T + new_from_old[:3, 3]
    for frame_id, cam_from_old in state.poses.items():
        state.poses[frame_id] = cam_from_old @ old_from_new


def to_trajectory(state: TrackState, frames: list[Frame]) -> Trajectory:
    """All frames, posed or with the reason why not."""
    keyframes = set(state.keyframes)
    return Trajectory(
        frame_ids=np.array([f.id for f in frames], np.int64),
        timestamps=np.array([f.timestamp for f in frames]),
        cam_from_world=np.array([state.poses.get(f.id, np.eye(4)) for f in frames]),
        is_keyframe=np.array([f.id in keyframes for f in frames]),
        lost_reasons=tuple("" if f.id in state.poses else state.lost.get(f.id, "not tracked") for f in frames),
    )


def to_sparse_model(state: TrackState) -> SparseModel:
    """Keyframes and the points that at least two of them see."""
    rows = [state.sightings[k] for k in state.keyframes]
    point = np.concatenate([r.point for r in rows])
    cam = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    keep = np.bincount(point, minlength=len(state.points))[point] >= 2
    used, renumbered = np.unique(point[keep], return_inverse=True)
    return SparseModel(
        np.array(state.keyframes, np.int64),
        np.array([state.poses[k] for k in state.keyframes]),
        state.points[used],
        state.colors[used],
        cam[keep].astype(np.int64),
        renumbered.astype(np.int64),
        np.concatenate([r.xy for r in rows])[keep],
    )
