"""Links: keyframes that are recognised where nothing has connected them so far, in another segment or where the path
comes back to. Both are found alike, by appearance, then as a lost frame is found again, and believed only where two
of them agree. Segments move into one world by them; then one graph of all of them spreads what is left
(`tracking.graph`)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..geometry import se3
from ..geometry.se3 import Similarity
from ..sfm.components import find_leaps, is_flat_within
from ..sfm.features import GlobalDescriptors, far_apart, loop_pairs
from ..sfm.rolling import FILM
from ..types import Array, LoopEdge
from .pnp import MIN_INLIERS, group_by_points, localise_in_groups
from .state import Pictures, Sightings, TrackState

GAP = 8
"""A loop joins keyframes at least this many apart."""
SHARED_POINTS = 15
"""Keyframes with this many points in common need no link."""
PER_KEYFRAME, MIN_ALIKE = 2, 0.02
"""Loops proposed by each keyframe's appearance, and the least appearance similarity of one."""
TRIES = 12
"""Keyframes of a segment that are looked for in another: the nearest in time, then those that look most like it."""
SHARE = 0.4
"""Of what was matched, the least that agrees with a link."""
DRIFT, ANGLE_DRIFT, SCALE_DRIFT = 0.05, 10.0, 1.5
"""A loop is false that claims more drift than this share of the path, more degrees, or a larger factor of scale."""
SCALE_SD = 0.03
"""No link is surer of the scale; where one tells less of it than `MAX_SCALE_SD`, it is none."""
MAX_SCALE_SD = 0.1
_Asked = tuple[int, list[int]]
_SAME_PLACE_PX, _MIN_RATIOS = 15.0, 8
"""Pixels within which two points have one depth, and how many of those tell a scale."""


@dataclass(frozen=True)
class Link:
    """The second keyframe of `edge` recognised by points of the first and of those around that.

    The edge's scale is by how much the path has grown from the first to the second, `scale_sd` its relative standard
    deviation; `seen`: the points in the second. `move` takes the world around the second to where the link puts it.
    """

    edge: LoopEdge
    scale_sd: float
    seen: Sightings
    move: Similarity

    @property
    def frame_id(self) -> int:
        """The keyframe that is recognised."""
        return self.edge.frame2_id


@dataclass(frozen=True)
class LinkSearch:
    """Looks for links in `state`; `refused` are pairs of keyframes that structure from motion has matched in vain,
    `near` those that match and follow on each other in a film, `times` (F,) of its frames in seconds."""

    state: TrackState
    pictures: Pictures
    seed: int
    refused: Collection[tuple[int, int]] = ()
    near: Collection[tuple[int, int]] = ()
    times: Array = field(default_factory=lambda: np.zeros(0))

    def recognise(self, frame_id: int, keyframes: Iterable[int]) -> Link | None:
        """Return the link of a keyframe to others, if it has enough in common with them for a pose and a scale."""
        state, groups = self.state, group_by_points(keyframes, self.state)
        seen, solved = localise_in_groups(frame_id, groups, state, self.pictures, self.seed)
        if solved is None or solved.inliers.sum() < max(MIN_INLIERS, SHARE * len(seen)):
            return None
        seen, pose = seen.select(solved.inliers), solved.cam_from_world
        scale, sd = self._depth_ratio(frame_id, pose, seen)
        if sd > MAX_SCALE_SD:
            return None
        near = [k for group in groups for k in group]
        anchor = max(near, key=lambda k: (int(np.isin(seen.point, state.sightings[k].point).sum()), -k))
        # anchor_from_cam @ cam_from_frame, distances around the frame stretched by the scale.
        back, own = se3.inverse(pose), state.poses[frame_id]
        move = Similarity(scale, back[:3, :3] @ own[:3, :3], scale * (back[:3, :3] @ own[:3, 3]) + back[:3, 3])
        motion = pose @ se3.inverse(state.poses[anchor])
        return Link(LoopEdge(anchor, frame_id, motion, 1 / scale, len(seen)), sd, seen, move)

    def _depth_ratio(self, frame_id: int, pose: Array, seen: Sightings) -> tuple[float, float]:
        """Depths of what is seen by the link over depths of what the frame itself sees in the same places, the median,
        and its relative standard deviation."""
        own = self.state.sightings[frame_id]
        if not len(own):
            return 1.0, np.inf
        distance = ((own.xy[None] - seen.xy[:, None]) ** 2).sum(2)
        nearest = distance.argmin(1)
        close = distance[np.arange(len(seen)), nearest] < _SAME_PLACE_PX**2
        theirs = self.state.points[seen.point[close]] @ pose[2, :3] + pose[2, 3]
        ours = self.state.depths(frame_id)[nearest[close]]
        good = (theirs > 0) & (ours > 0)
        if good.sum() < _MIN_RATIOS:
            return 1.0, np.inf
        ratio = np.log(theirs[good] / ours[good])
        middle = float(np.median(ratio))
        spread = 1.86 * float(np.median(np.abs(ratio - middle))) / np.sqrt(good.sum())  # of a median
        return float(np.exp(middle)), max(spread, SCALE_SD)

    def join_segments(self) -> list[Link]:
        """Move every segment that can be recognised in a larger one into its world, in place; the links."""
        links: list[Link] = []
        rest = list(self.state.segment_sizes())
        while rest:
            main, *others = rest
            tried = ((segment, self._between(segment, main)) for segment in others)
            joined, found = next(((s, f) for s, f in tried if f), (None, []))
            if joined is None:
                rest = others
                continue
            move = found[0].move
            move_segment(joined, main, move, self.state)
            links += [replace(n, edge=replace(n.edge, scale=n.edge.scale * move.scale)) for n in found]
            rest.remove(joined)
        return links

    def _between(self, segment: int, main: int) -> list[Link]:
        """Return the links of one segment to another, the most that agree with each other; none where no two do."""
        state = self.state
        ours, theirs = ([k for k in state.keyframes if state.segment[k] == s] for s in (segment, main))
        if not (ours and theirs):
            return []
        alike = self.pictures.similarities(self.pictures.descriptors(ours), theirs)
        gap = np.array([np.abs(np.subtract(theirs, k)).min() for k in ours])
        tried = np.argsort(gap, kind="stable")[: TRIES // 3].tolist()
        tried += [i for i in np.argsort(-alike.max(1), kind="stable")[:TRIES].tolist() if i not in tried]
        found: list[Link] = []
        for n in tried:
            known = {theirs[i] for i in np.argsort(-alike[n], kind="stable")[:3].tolist()}
            known |= set(sorted(theirs, key=lambda k: abs(k - ours[n]))[:2])
            if (link := self.recognise(ours[n], known)) is not None:
                found.append(link)
        agreeing = max((self._agreeing(link, found) for link in found), key=len, default=[])
        if len(agreeing) < 2 or self._leaps(segment, main, agreeing[0].move) or self._is_one_thing(agreeing, theirs):
            return []
        return agreeing

    def _is_one_thing(self, links: Iterable[Link], keyframes: Iterable[int]) -> bool:
        """Whether links to these keyframes recognise one plane in a room: doors and pictures are alike."""
        state = self.state
        shared = np.unique(np.concatenate([link.seen.point for link in links]))
        around = np.unique(np.concatenate([state.sightings[k].point for k in keyframes]))
        return is_flat_within(state.points[shared], state.points[around])

    def _leaps(self, segment: int, main: int, move: Similarity) -> bool:
        """Whether the camera of a film would leap between two segments, of which `move` takes the first to the other,
        where images on both sides match: rooms look alike in more than one place."""
        if not self.near:
            return False
        state = self.state
        ids = np.array([i for i in sorted(state.poses) if state.segment[i] in (segment, main)])
        moved = np.array([state.segment[i] == segment for i in ids.tolist()])
        centers = se3.inverse(np.array([state.poses[i] for i in ids.tolist()]))[:, :3, 3]
        centers[moved] = move.apply(centers[moved])
        leaps = [ids[n - 1 : n + 1] for n in find_leaps(centers, self.times[ids]) if moved[n - 1] != moved[n]]
        return any(
            self.times[after] - self.times[before] > FILM or any(a <= before and after <= b for a, b in self.near)
            for before, after in leaps
        )

    def loops(self, track: Callable[[list[_Asked]], Iterable[_Asked]]) -> list[Link]:
        """Return the links within segments that the path can have drifted by and that a second one supports; `track`
        shows progress."""
        ids, known = self.state.keyframes, defaultdict[int, list[int]](list)
        if len(ids) <= GAP:
            return []
        descriptors = GlobalDescriptors((self.pictures.descriptors(ids).astype(np.float32),))
        for i, j in loop_candidates(self.state, descriptors, self.refused):
            known[j].append(i)
        found: list[Link] = []
        for later, earlier in track(sorted(known.items())):
            # Place by place: of two that look the same the path tells which it can be.
            places = (self.recognise(later, group) for group in group_by_points(earlier, self.state))
            found += [link for link in places if link is not None and self._is_plausible(link)]
        place = {k: n for n, k in enumerate(ids)}
        return [link for link in found if len(self._agreeing(link, found)) > 1 or self._has_neighbour(link, place)]

    def _agreeing(self, link: Link, others: Iterable[Link]) -> list[Link]:
        """The link itself, and those others that put its keyframe in nearly the same place."""
        pose, depth = self.state.poses[link.frame_id], self.state.median_depth(link.frame_id)
        same = (o for o in others if o.frame_id != link.frame_id and agree(link.move, o.move, pose, depth))
        return [link, *same]

    def _has_neighbour(self, link: Link, place: dict[int, int]) -> bool:
        """Whether a keyframe beside the link's is recognised there too, and agrees."""
        at, ids = place[link.frame_id], self.state.keyframes
        for k in ids[max(at - 1, 0) : at] + ids[at + 1 : at + 2]:
            other = self.recognise(k, [link.edge.frame1_id])
            if other is not None and len(self._agreeing(link, [other])) > 1:
                return True
        return False

    def _is_plausible(self, link: Link) -> bool:
        """Whether the path between can have drifted as far as the loop claims."""
        state, edge = self.state, link.edge
        first, second = edge.frame1_id, edge.frame2_id
        ways = [se3.inverse(state.poses[k])[:3, 3] for k in state.keyframes if first <= k <= second]
        path = float(np.linalg.norm(np.diff(ways, axis=0), axis=1).sum())
        now, then = state.poses[second] @ se3.inverse(state.poses[first]), edge.frame2_from_frame1
        distance = float(np.linalg.norm(se3.inverse(now)[:3, 3] - se3.inverse(then)[:3, 3]))
        return bool(
            distance <= DRIFT * (path + state.median_depth(first))
            and se3.rotation_angle(then @ se3.inverse(now)) <= np.radians(ANGLE_DRIFT)
            and abs(np.log(edge.scale)) <= np.log(SCALE_DRIFT)
        )


def loop_candidates(
    state: TrackState, descriptors: GlobalDescriptors, refused: Collection[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Return pairs of keyframes, earlier first: the most alike of each one that are of its segment, far from it in the
    sequence, and have hardly a point in common with it; none of the `refused`."""
    ids = state.keyframes
    segment, shared, apart = np.array([state.segment[k] for k in ids]), shared_points(state), far_apart(len(ids), GAP)

    def unrelated(part: slice) -> NDArray[np.bool_]:
        return apart(part) & (shared[part].toarray() < SHARED_POINTS) & (segment[part, None] == segment)

    alike = loop_pairs(descriptors, unrelated, PER_KEYFRAME, MIN_ALIKE)
    return [(ids[i], ids[j]) for i, j in alike if (ids[i], ids[j]) not in refused]


def shared_points(state: TrackState) -> csr_matrix:
    """(N, N): how many points two keyframes both see."""
    rows = [state.sightings[k].point for k in state.keyframes]
    keyframe = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    point = np.concatenate([np.zeros(0, np.int64), *rows])
    seen = csr_matrix((np.ones(len(point), np.int32), (keyframe, point)), (len(rows), len(state.points)))
    return (seen @ seen.T).tocsr()


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


def add_sightings(state: TrackState, links: Iterable[Link]) -> None:
    """Each link's keyframe sees the points that it was recognised by; one already seen keeps its first sighting."""
    for link in links:
        known = state.sightings[link.frame_id]
        state.sightings[link.frame_id] = known.joined(link.seen.select(~np.isin(link.seen.point, known.point)))
