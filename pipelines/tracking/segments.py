"""Segments of what structure from motion leaves, and what given poses say of segments and of lost frames."""

from collections import Counter
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry import se3
from ..geometry.se3 import Similarity
from ..run.files import GIVEN_POSES
from ..run.stages import StageContext
from ..sfm.given import fit_given_poses
from ..system.wording import stretches
from ..types import Array, GivenPoses
from .links import move_segment
from .state import NO_SIGHTINGS, TrackState

_MAX_SCALE_SD = 0.1
"""Relative: over a stretch about as short as their own errors, given poses do not determine the scale."""
_MIN_PATH, _JUMP = 5, 5.0
"""Poses that make a path, and how many times as far as is usual a wrong one lies aside of it."""


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


def carry_given(context: StageContext, state: TrackState) -> dict[str, Any]:
    """Join the state's segments by the given poses, and pose lost frames by them, in place; figures of it."""
    given = context.run.find(GIVEN_POSES)
    if given is None:
        return {}
    drop_inconsistent_segments(state, given)
    joined = join_by_given(state, given)
    carried = pose_lost(state, given)
    if joined:
        context.warn(
            f"{joined} disconnected components (no image links them to the rest) are placed by --poses alone: they are "
            "as accurate as those poses"
        )
    if carried:
        context.warn(
            f"{len(carried)} frames ({stretches(carried)}) are posed by --poses alone: the images say nothing of them"
        )
    return {"given_joined": joined, "given_carried": len(carried)}


def drop_inconsistent_segments(state: TrackState, given: GivenPoses) -> None:
    """Lose, in place, every segment that the given poses cannot place (too short for its scale, or contradicted by
    them) but could replace: where most of its frames have one, and more frames outside than are in it."""
    known = set(np.flatnonzero(given.known).tolist())
    for segment in sorted(set(state.segment.values())):
        inside = {i for i, s in state.segment.items() if s == segment}
        is_replaced = 2 * len(inside & known) > len(inside) and len(known - inside) > len(inside)
        if is_replaced and _to_given(state, given, segment) is None:
            for i in sorted(inside):
                state.remove_frame(i)
                state.lost[i] = "its surroundings do not agree with the given poses"


def join_by_given(state: TrackState, given: GivenPoses) -> int:
    """Move every segment that shares frames with the given poses to where these put it beside the largest; how many."""
    order = list(state.segment_sizes())
    main = _to_given(state, given, order[0]) if order else None
    joined = 0
    for segment in order[1:] if main is not None else []:
        own = _to_given(state, given, segment)
        if own is not None and main is not None:
            move_segment(segment, order[0], main.inverse() @ own, state)
            joined += 1
    return joined


def _to_given(state: TrackState, given: GivenPoses, segment: int) -> Similarity | None:
    """given_from_state by the posed frames of a segment that have a given pose; None where they determine no scale."""
    ids = [i for i in sorted(state.poses) if state.segment[i] == segment and given.known[i]]
    found = np.array([state.poses[i] for i in ids]).reshape(-1, 4, 4)
    agreed = fit_given_poses(found, given.cam_from_world[ids])
    return None if agreed is None or agreed.scale_sd > _MAX_SCALE_SD else agreed.move


def pose_lost(state: TrackState, given: GivenPoses) -> list[int]:
    """Pose every lost frame that has a given pose, in place: the given path is bent so that it runs through the posed
    frames on both sides. The frames that were. Where nothing is posed the world is the given one."""
    astray = stray(given)
    lost = [i for i in sorted(state.lost) if given.known[i] and i not in astray]
    if not lost:
        return []
    is_new = not state.segment
    segment = next(iter(state.segment_sizes()), 0)
    move = Similarity(1.0, np.eye(3), np.zeros(3)) if is_new else _to_given(state, given, segment)
    if move is None:
        return []
    known = np.flatnonzero(given.known)
    here = dict(zip(known.tolist(), move.inverse().apply_to_poses(given.cam_from_world[known]), strict=True))
    posed = [i for i in sorted(state.poses) if state.segment[i] == segment]
    off = _offs(state, here, posed)
    for i in lost:
        state.add_frame(i, _bend(i, off) @ here[i], NO_SIGHTINGS, is_new, segment)
    return lost


def stray(given: GivenPoses) -> set[int]:
    """Frames whose given pose is far from the way between those before and behind: no camera jumps there and back."""
    known = np.flatnonzero(given.known)
    if len(known) < _MIN_PATH:
        return set()
    centre = se3.inverse(given.cam_from_world[known])[:, :3, 3]
    share = ((known[1:-1] - known[:-2]) / (known[2:] - known[:-2]))[:, None]
    aside = np.linalg.norm(centre[1:-1] - (1 - share) * centre[:-2] - share * centre[2:], axis=1)
    apart = np.linalg.norm(centre[2:] - centre[:-2], axis=1)
    is_far = (aside > _JUMP * np.median(aside)) & (aside > _JUMP * np.median(apart)) & (aside > apart)
    return set(known[1:-1][is_far].tolist())


def _offs(state: TrackState, here: dict[int, Array], posed: list[int]) -> dict[int, Array]:
    """By frame, the motion that takes its given pose to its own; without those that are wrong altogether."""
    both = [i for i in posed if i in here]
    if not both:
        return {}
    agreed = fit_given_poses(np.array([state.poses[i] for i in both]), np.array([here[i] for i in both]))
    wrong = np.zeros(len(both), np.bool_) if agreed is None else agreed.wrong
    return {i: state.poses[i] @ se3.inverse(here[i]) for i, bad in zip(both, wrong, strict=True) if not bad}


def _bend(frame_id: int, off: dict[int, Array]) -> Array:
    """(4, 4) between the motions of the nearest frames before and behind, by how near each is."""
    before = max((i for i in off if i < frame_id), default=None)
    behind = min((i for i in off if i > frame_id), default=None)
    if before is None or behind is None:
        nearest = behind if before is None else before
        return np.eye(4) if nearest is None else off[nearest]
    share = (frame_id - before) / (behind - before)
    return np.asarray(off[before] @ se3.exp(share * se3.log(se3.inverse(off[before]) @ off[behind])), np.float64)
