"""Cameras that look in several directions from one place have one pose among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import se3
from pipelines.geometry.rig import Rig
from pipelines.tracking.state import NO_SIGHTINGS, TrackState

Array = NDArray[np.float64]


def settle_places(state: TrackState) -> None:
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


def tie_cameras(
    blocks: Array, pairs: NDArray[np.int64], right: Array, frame_ids: NDArray[np.int64], rig: Rig
) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """The upper blocks (B, 6, 6) at pairs (B, 2) and right sides (6 N,) of N cameras as those of their S places.

    A step d of a place moves its camera c by adjoint(cam_from_rig[c]) d, which here is a turn of both halves: see
    Sola et al., A micro Lie theory for state estimation in robotics, eq. (20). Returns blocks, pairs, right sides, the
    place of each camera (N,) and the turns (N, 6, 6).
    """
    _, place = np.unique(frame_ids % rig.stations, return_inverse=True)
    turns = np.zeros((len(rig), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = rig.cam_from_rig
    turns = turns[frame_ids // rig.stations]
    moved = np.swapaxes(turns[pairs[:, 0]], 1, 2) @ blocks @ turns[pairs[:, 1]]
    first, second = place[pairs[:, 0]], place[pairs[:, 1]]
    within = (first == second) & (pairs[:, 0] != pairs[:, 1])
    moved[within] += np.swapaxes(moved[within], 1, 2)
    turned = first > second
    moved[turned] = np.swapaxes(moved[turned], 1, 2)
    of_places = np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1)
    kept, row = np.unique(of_places, axis=0, return_inverse=True)
    total = np.zeros((len(kept), 6, 6))
    np.add.at(total, row.ravel(), moved)
    pull = np.zeros((int(place.max()) + 1, 6))
    np.add.at(pull, place, np.einsum("nji,nj->ni", turns, right.reshape(-1, 6)))
    return total, kept, pull.ravel(), place, turns
