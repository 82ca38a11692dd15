"""Cameras that look in several directions from one place have one pose among them."""

from __future__ import annotations

from ..geometry import se3
from .state import NO_SIGHTINGS, TrackState


def sync_rig_poses(state: TrackState) -> None:
    """Pose all directions of each place, in place, by the one that sees most points; nothing for a single camera."""
    if len(state.rig) == 1:
        return
    motions = state.rig.motions
    for station in range(state.rig.stations):
        frames = state.rig.frames_of([station])
        posed = [i for i in frames if i in state.poses]
        if not posed:
            continue
        best = max(posed, key=lambda i: (len(state.sightings[i]), -i))
        rig_from_world = se3.inverse(motions[frames.index(best)]) @ state.poses[best]
        segment = state.segment[best]
        for frame_id, motion in zip(frames, motions, strict=True):
            same = state.segment.get(frame_id, segment) == segment
            seen = state.sightings.get(frame_id, NO_SIGHTINGS) if same else NO_SIGHTINGS
            state.add_frame(frame_id, motion @ rig_from_world, seen, False, segment)
