"""Joining stretches that began anew after a loss, when a keyframe of one is recognised in another."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry import se3
from ..geometry.alignment import Similarity
from .pictures import Pictures
from .pnp import MIN_INLIERS
from .relocalise import group_by_points, recognise
from .state import Sightings, TrackState

Array = NDArray[np.float64]

TRIES = 12
"""Keyframes of a segment that are looked for in another: the nearest in time, then those that look most like it."""


def join_segments(state: TrackState, pictures: Pictures, seed: int) -> int:
    """Bring every segment that can be recognised into the largest one's world; returns how many were joined.

    One keyframe is not believed: two must be recognised, and agree on the transform between the worlds.
    """
    joined, again = 0, True
    while again:
        again = False
        main, *others = state.segment_sizes() or [0]
        for segment in others:
            if _join(segment, main, state, pictures, seed):
                joined, again = joined + 1, True
                break
    return joined


def split_segments(state: TrackState) -> None:
    """Number the segments of the backbone, in place: keyframes that no chain of common points joins are of different
    ones, larger ones first. A keyframe without points is none: it will be tracked like any other frame."""
    for frame_id in [k for k in state.keyframes if len(state.sightings[k]) == 0]:
        state.remove_frame(frame_id)
    rows = [state.sightings[k].point for k in state.keyframes]
    # Places hold views together as points do.
    rows = [
        np.append(r, len(state.points) + k % state.rig.stations) for r, k in zip(rows, state.keyframes, strict=True)
    ]
    keyframe = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    point = np.concatenate([np.zeros(0, np.int64), *rows])
    size = len(rows) + int(point.max(initial=0)) + 1
    seen = coo_matrix((np.ones(len(point), np.int8), (keyframe, len(rows) + point)), (size, size))
    _, label = connected_components(seen, directed=False)
    of_keyframe = label[: len(rows)].tolist()
    counts = Counter(of_keyframe)
    order = sorted(counts, key=lambda c: (-counts[c], of_keyframe.index(c)))
    for frame_id, component in zip(state.keyframes, of_keyframe, strict=True):
        state.segment[frame_id] = order.index(component)


def _join(segment: int, main: int, state: TrackState, pictures: Pictures, seed: int) -> bool:
    ours = [k for k in state.keyframes if state.segment[k] == segment]
    theirs = [k for k in state.keyframes if state.segment[k] == main]
    looks = np.array([[float(pictures.descriptor(a) @ pictures.descriptor(b)) for b in theirs] for a in ours])
    answers: list[tuple[int, Similarity, Sightings]] = []
    gap = np.array([min(abs(a - b) for b in theirs) for a in ours])
    near = np.argsort(gap, kind="stable")[: TRIES // 3].tolist()
    for n in near + [i for i in np.argsort(-looks.max(1), kind="stable")[:TRIES].tolist() if i not in near]:
        alike = [theirs[i] for i in np.argsort(-looks[n], kind="stable")[:3]]
        alike += [k for k in sorted(theirs, key=lambda k: abs(k - ours[n]))[:2] if k not in alike]
        found = _recognise(ours[n], alike, state, pictures, seed)
        if found is None:
            continue
        depth = state.median_depth(ours[n])
        if any(agree(found[0], other, state.poses[ours[n]], depth) for _, other, _ in answers):
            answers.append((ours[n], *found))
            move_segment(segment, main, found[0], state)
            for frame_id, _, seen in answers:
                known = state.sightings[frame_id]
                state.sightings[frame_id] = known.joined(seen.select(~np.isin(seen.point, known.point)))
            return True
        answers.append((ours[n], *found))
    return False


def _recognise(
    frame_id: int, keyframes: list[int], state: TrackState, pictures: Pictures, seed: int
) -> tuple[Similarity, Sightings] | None:
    """main_from_segment, and the main segment's points in the frame."""
    groups = group_by_points(keyframes, state)
    seen, solved = recognise(frame_id, groups, state, pictures, seed)
    if solved is None or solved.inliers.sum() < max(MIN_INLIERS, 0.4 * len(seen)):
        return None
    seen = seen.select(solved.inliers)
    scale = _depth_ratio(frame_id, solved.cam_from_world, seen, state)
    # main_from_cam @ cam_from_segment, distances in the segment stretched by the scale.
    main_from_cam, cam_from_segment = se3.inverse(solved.cam_from_world), state.poses[frame_id]
    rotation = main_from_cam[:3, :3] @ cam_from_segment[:3, :3]
    translation = scale * (main_from_cam[:3, :3] @ cam_from_segment[:3, 3]) + main_from_cam[:3, 3]
    return Similarity(scale, rotation, translation), seen


def _depth_ratio(frame_id: int, cam_from_main: Array, seen: Sightings, state: TrackState) -> float:
    """Unit of the segment in units of the main world: depths of what both worlds see in the same places."""
    own = state.sightings[frame_id]
    distance = ((own.xy[None] - seen.xy[:, None]) ** 2).sum(2)
    nearest = distance.argmin(1)
    close = distance[np.arange(len(seen)), nearest] < 15.0**2
    if close.sum() < 8:
        return 1.0
    motion = state.poses[frame_id]
    theirs = state.points[seen.point[close]] @ cam_from_main[2, :3] + cam_from_main[2, 3]
    ours = state.points[own.point[nearest[close]]] @ motion[2, :3] + motion[2, 3]
    good = (theirs > 0) & (ours > 0)
    return float(np.exp(np.median(np.log(theirs[good] / ours[good])))) if good.sum() >= 8 else 1.0


def agree(first: Similarity, second: Similarity, cam_from_world: Array, depth: float) -> bool:
    """Whether both put this camera in nearly the same place: 3 degrees, a tenth of the depth it sees, a tenth of scale.

    `depth` is in the unit that both similarities start from. Where either world has its origin does not matter.
    """
    a, b = (s.apply_to_poses(cam_from_world[None])[0] for s in (first, second))
    apart = a @ se3.inverse(b)
    return bool(
        se3.rotation_angle(apart) < np.radians(3)
        and np.linalg.norm(apart[:3, 3]) < 0.1 * first.scale * depth
        and abs(np.log(first.scale / second.scale)) < 0.1
    )


def move_segment(segment: int, main: int, main_from_segment: Similarity, state: TrackState) -> None:
    """Poses and points of a segment into the main one's world."""
    frames = [i for i in sorted(state.poses) if state.segment[i] == segment]
    points = np.unique(np.concatenate([state.sightings[i].point for i in frames]))
    state.points[points] = main_from_segment.apply(state.points[points])
    for i in frames:
        state.poses[i] = main_from_segment.apply_to_poses(state.poses[i][None])[0]
        state.segment[i] = main
