"""Finding a lost frame again among the keyframes: by how it looks, then by SIFT and PnP."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipelines.config import TrackingConfig
from pipelines.tracking.features import match_features
from pipelines.tracking.pictures import Pictures
from pipelines.tracking.pnp import FramePose, solve_pose
from pipelines.tracking.state import NO_SIGHTINGS, Sightings, TrackState
from pipelines.types import Intrinsics

SNAP = 2.0
"""A SIFT feature within so many pixels of a keyframe's sighting stands for the same point."""


def relocalise(
    frame_id: int,
    state: TrackState,
    pictures: Pictures,
    intrinsics: Intrinsics,
    settings: TrackingConfig,
    seed: int,
) -> tuple[Sightings, FramePose | None]:
    """Sightings from the keyframes that look most like the frame, and the pose they agree on, if any."""
    best: tuple[Sightings, FramePose | None] = (NO_SIGHTINGS, None)
    for group in _candidate_groups(frame_id, state, pictures, settings.relocalise_candidates):
        seen = NO_SIGHTINGS
        for keyframe in group:
            found = match_keyframe(frame_id, keyframe, state, pictures)
            seen = seen.joined(found.select(~np.isin(found.point, seen.point)))
        points = state.points[seen.point]
        solved = solve_pose(seen.xy, points, intrinsics, seed + frame_id, None, settings.pose_error)
        if solved is not None and (best[1] is None or solved.inliers.sum() > best[1].inliers.sum()):
            best = (seen, solved)
    return best


def match_keyframe(frame_id: int, keyframe: int, state: TrackState, pictures: Pictures) -> Sightings:
    """The keyframe's points found in the frame by SIFT; the frame's pixels are good to about one."""
    known = state.sightings[keyframe]
    if len(known) == 0:
        return NO_SIGHTINGS
    theirs, ours = pictures.features(keyframe), pictures.features(frame_id)
    pairs = match_features(theirs, ours)
    distance, nearest = cKDTree(known.xy).query(theirs.xy[pairs[:, 0]], distance_upper_bound=SNAP)
    keep = np.isfinite(distance)
    points, pairs = known.point[nearest[keep]], pairs[keep]
    _, first = np.unique(points, return_index=True)
    first = np.sort(first)
    return Sightings(points[first], ours.xy[pairs[first, 1]], np.full(len(first), 1.0))


def _candidate_groups(frame_id: int, state: TrackState, pictures: Pictures, count: int) -> list[list[int]]:
    """Keyframes worth matching, those that belong together in time in one group, so that their points add up."""
    if not state.keyframes:
        return []
    ours = pictures.descriptor(frame_id)
    scores = np.array([float(pictures.descriptor(k) @ ours) for k in state.keyframes])
    alike = [state.keyframes[i] for i in np.argsort(-scores, kind="stable")[:count]]
    groups: list[list[int]] = []
    for keyframe in sorted({*alike, *state.nearest_keyframes(frame_id, 1)}):
        place = state.keyframes.index(keyframe)
        joins = groups and state.keyframes.index(groups[-1][-1]) >= place - 1
        same = joins and state.segment[groups[-1][-1]] == state.segment[keyframe]
        if same:
            groups[-1].append(keyframe)
        else:
            groups.append([keyframe])
    return groups
