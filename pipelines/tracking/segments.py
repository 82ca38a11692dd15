"""Joining stretches that began anew after a loss, when a keyframe of one is recognised in another."""

from collections import Counter, deque
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
from .pnp import MIN_INLIERS, group_by_points, localise_in_groups
from .state import NO_SIGHTINGS, Pictures, Sightings, TrackState

_MAX_SCALE_SD = 0.1
"""Relative: over a stretch about as short as their own errors, given poses do not determine the scale."""
_MIN_PATH, _JUMP = 5, 5.0
"""Poses that make a path, and how many times as far as is usual a wrong one lies aside of it."""

TRIES = 12
"""Keyframes of a segment that are looked for in another: the nearest in time, then those that look most like it."""


def join_segments(state: TrackState, pictures: Pictures, seed: int) -> int:
    """Bring every segment that can be recognised into the largest one's world; returns how many were joined.

    One keyframe is not believed: two must be recognised, and agree on the transform between the worlds.
    """
    main, *others = state.segment_sizes() or [0]
    waiting, since = deque(others), 0
    while since < len(waiting):  # those that have not been compared with what joined since
        segment = waiting.popleft()
        since += 1
        if _join(segment, main, state, pictures, seed):
            since = 0
        else:
            waiting.append(segment)
    return len(others) - len(waiting)


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
    similarity = pictures.similarities(pictures.descriptors(ours), theirs)
    answers: list[tuple[int, Similarity, Sightings]] = []
    gap = np.array([np.abs(np.subtract(theirs, a)).min() for a in ours])
    near = np.argsort(gap, kind="stable")[: TRIES // 3].tolist()
    for n in near + [i for i in np.argsort(-similarity.max(1), kind="stable")[:TRIES].tolist() if i not in near]:
        alike = [theirs[i] for i in np.argsort(-similarity[n], kind="stable")[:3]]
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
    seen, solved = localise_in_groups(frame_id, groups, state, pictures, seed)
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
    """Return whether both put this camera in nearly the same place: 3 degrees, a tenth of the depth it sees, a tenth of
    scale.

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
    """Move poses and points of a segment into the main one's world."""
    frames = [i for i in sorted(state.poses) if state.segment[i] == segment]
    points = np.unique(np.concatenate([state.sightings[i].point for i in frames]))
    state.points[points] = main_from_segment.apply(state.points[points])
    for i in frames:
        state.poses[i] = main_from_segment.apply_to_poses(state.poses[i][None])[0]
        state.segment[i] = main


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
