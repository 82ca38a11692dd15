"""The front end: every frame that structure from motion left out is posed against the keyframes around it; where there
are none, there are new keyframes, with points from proxy depth or triangulated from the last one."""

import math

import numpy as np
from numpy.typing import NDArray

from ..depth.align import sample_proxy, scale_at_points
from ..geometry import se3
from ..geometry.camera import nearest_along, project, unproject
from ..sfm.adjust import FEATURE_SD
from ..sfm.flow import FLOW_SD, find_corners, follow
from ..types import Array, Intrinsics
from .pnp import MIN_INLIERS, POSE_ERROR, FramePose, predict_pose, relocalise, solve_pose
from .state import NO_SIGHTINGS, Pictures, Sightings, TrackState

NEW_POINTS = 300
"""Points that a new keyframe should have."""
MIN_ANGLE = np.radians(1.5)
"""Rays that meet at a smaller angle say nothing of the depth."""

PATCH = 15
"""Side in pixels of what is followed from a keyframe. With 21 the path of a living room is a third worse, that of a
staircase a tenth. Keyframes are chosen, and bridged, with 21: with 15 a kitchen's focal length was 0.4 % off."""
REACH = 60
"""Frames within which a neighbour still says something of where a frame is."""
KEYFRAME_SHARE = 0.6
"""Where structure from motion has none, what sees less than this share of its keyframe's points is a keyframe."""


class FrontEnd:
    """Poses frames one after the other, in the order of their ids, into a `TrackState`."""

    def __init__(self, state: TrackState, pictures: Pictures, seed: int) -> None:
        self.state, self.pictures, self.seed = state, pictures, seed
        self.is_rig = len(state.rig) > 1
        self.times = {i: frame.timestamp for i, frame in pictures.frames.items()}
        self.looked: dict[int, int] = {}

    def track(self, frame_id: int, may_start: bool = True) -> None:
        """Pose one frame, or note why it is lost.

        In turn: by flow from the keyframes around it; the same after the last posed frame has become a keyframe, where
        there is none ahead; by recognising it; and, where `may_start`, as the beginning of a new segment.
        """
        seen, solved, start = self.by_flow(frame_id)
        reason = f"{len(seen)} points followed from its keyframes, {_count(solved)} agree on a pose"
        if not self.is_trusted(seen, solved) and self.extend_before(frame_id):
            seen, solved, start = self.by_flow(frame_id)
        # As long as there is no further keyframe, a frame that was recognised nowhere is not.
        if not self.is_trusted(seen, solved) and self.looked.get(frame_id) != len(self.state.keyframes):
            self.looked[frame_id] = len(self.state.keyframes)
            seen, solved = relocalise(frame_id, self.state, self.pictures, self.seed)
            reason += f"; {len(seen)} matched in similar keyframes, {_count(solved)} agree"
        if solved is not None and self.is_trusted(seen, solved):
            segment = self.state.segment_of_point(int(seen.point[solved.inliers][0]), frame_id)
            self.state.add_frame(frame_id, solved.cam_from_world, seen.select(solved.inliers), False, segment)
            self.extend_at(frame_id)
        elif not (may_start and self._start(frame_id, start)):
            self.state.lost.setdefault(frame_id, reason)

    def by_flow(self, frame_id: int) -> tuple[Sightings, FramePose | None, Array | None]:
        """Sightings, the pose they agree on, and the predicted one, in the segment of the frames before."""
        camera = frame_id // self.state.rig.stations
        reach = [i for i in range(frame_id - REACH, frame_id + REACH) if i // self.state.rig.stations == camera]
        near = {i: self.state.poses[i] for i in reach if i in self.state.poses}
        if not near:
            return NO_SIGHTINGS, None, None
        closest = min(near, key=lambda i: (abs(i - frame_id), i))
        segment = self.state.segment[closest]
        near = {i: pose for i, pose in near.items() if self.state.segment[i] == segment}
        keyframes = [k for k in self.state.nearest_keyframes(frame_id, 2) if self.state.segment[k] == segment]
        start = predict_pose(frame_id, near, self.times)
        if start is None or not keyframes:
            return NO_SIGHTINGS, None, start
        seen = self.correspond(frame_id, start, keyframes)
        return seen, self.solve(frame_id, seen, start), start

    def is_inside(self, frame_id: int) -> bool:
        """Return whether keyframes of one segment are on both sides: then there is no need for new ones."""
        nearest = self.state.nearest_keyframes(frame_id, 1)
        if len(nearest) < 2 or abs(nearest[0] - nearest[1]) >= REACH:
            return False
        return self.state.segment[nearest[0]] == self.state.segment[nearest[1]]

    def extend_at(self, frame_id: int) -> None:
        """Make the frame a keyframe when it sees much less than its keyframe did, and there is none ahead."""
        nearest = self.state.nearest_keyframes(frame_id, 1)
        if self.is_inside(frame_id) or not nearest:
            return
        share = len(self.state.sightings[frame_id]) / max(len(self.state.sightings[nearest[0]]), 1)
        if share < KEYFRAME_SHARE:
            self.promote(frame_id)

    def extend_before(self, frame_id: int) -> bool:
        """Make the posed frame next to this one a keyframe, where there is none ahead; whether that was possible."""
        near = [i for i in (frame_id - 1, frame_id + 1) if i in self.state.poses and i not in self.state.keyframes]
        if not near or self.is_inside(frame_id):
            return False
        self.promote(near[0])
        return True

    def correspond(self, frame_id: int, start: Array, keyframes: list[int], most: float = math.inf) -> Sightings:
        """Points of the keyframes, about so many of each at `most`, found in the frame by KLT, searched from where
        `start` (4, 4) puts them."""
        seen = NO_SIGHTINGS
        grey = self.pictures.grey(frame_id)
        for keyframe in keyframes:
            known = self.state.sightings[keyframe]
            rows = np.flatnonzero(~np.isin(known.point, seen.point))
            known = known.select(rows[:: int(len(rows) // most) + 1])
            points = self.state.points[known.point]
            guess, _ = project(points @ start[:3, :3].T + start[:3, 3], self.pictures.intrinsics)
            xy, found = follow(self.pictures.grey(keyframe), grey, known.xy, guess, window=PATCH)
            found &= self.pictures.is_scene(frame_id, xy)
            seen = seen.joined(Sightings.of(known.point[found], xy[found], FLOW_SD, keyframe))
        return seen

    def solve(self, frame_id: int, seen: Sightings, start: Array | None) -> FramePose | None:
        """Find the pose that most of the sightings agree on."""
        points = self.state.points[seen.point]
        return solve_pose(seen.xy, points, self.pictures.intrinsics, self.seed + frame_id, start)

    def is_trusted(self, seen: Sightings, solved: FramePose | None) -> bool:
        """Enough points agree, and not by a small minority, which is how a wrong pose looks."""
        return _count(solved) >= MIN_INLIERS and _count(solved) >= 0.4 * len(seen)

    def promote(self, frame_id: int) -> None:
        """Make a posed frame a keyframe with new points."""
        state = self.state
        earlier = [k for k in state.nearest_keyframes(frame_id, 2) if state.segment[k] == state.segment[frame_id]]
        state.keyframes = sorted({*state.keyframes, frame_id})
        if earlier:
            self._triangulate(earlier[0], frame_id)
        self._add_from_proxy(frame_id)

    def _start(self, frame_id: int, start: Array | None) -> bool:
        """Begin anew from one frame's proxy depth; return False, with nothing changed, when it has too few points for
        that."""
        state = self.state
        if self.is_rig or self.pictures.proxy(frame_id) is None:
            return False
        before, segment = len(state.points), max(state.segment.values(), default=-1) + 1
        state.add_frame(frame_id, np.eye(4) if start is None else start, NO_SIGHTINGS, True, segment)
        if self._add_from_proxy(frame_id) >= MIN_INLIERS:
            return True
        state.remove_frame(frame_id)
        state.points, state.colors = state.points[:before], state.colors[:before]
        return False

    def _add_from_proxy(self, frame_id: int) -> int:
        """Add corners that are no points yet, at the proxy depth, scaled to agree with the points the frame sees; how
        many there are."""
        pictures, maps = self.pictures, self.pictures.proxy(frame_id)
        if maps is None:
            return 0
        seen, intrinsics = self.state.sightings[frame_id], pictures.intrinsics
        count = max(NEW_POINTS - len(seen), 0)
        xy = find_corners(pictures.grey(frame_id), seen.xy, count, left_out=pictures.left_out(frame_id))
        depth, _ = sample_proxy(maps, xy, intrinsics)
        scale = scale_at_points(maps, seen.xy, self.state.depths(frame_id), intrinsics, MIN_INLIERS) or 1.0
        good = depth > 0
        self._add(unproject(xy[good], depth[good] * scale, intrinsics), {frame_id: xy[good]})
        return int(good.sum())

    def _triangulate(self, first: int, second: int) -> None:
        """Add corners of the first keyframe that are no points yet, followed into the second."""
        state, pictures, intrinsics = self.state, self.pictures, self.pictures.intrinsics
        grey = pictures.grey(first)
        xy = find_corners(grey, state.sightings[first].xy, NEW_POINTS, left_out=pictures.left_out(first))
        motion = state.poses[second] @ se3.inverse(state.poses[first])
        guess, _ = project(se3.transform(motion, unproject(xy, self._nearby_depth(first, xy), intrinsics)), intrinsics)
        there, found = follow(grey, pictures.grey(second), xy, guess)
        found &= pictures.is_scene(second, there)
        xy, there = xy[found], there[found]
        in_first, good = triangulate(xy, there, motion, intrinsics, POSE_ERROR)
        self._add(in_first[good], {first: xy[good], second: there[good]})

    def _nearby_depth(self, frame_id: int, xy: Array) -> Array:
        """(Q,) depth of the nearest known point in the image: a fair first guess."""
        seen, z = self.state.sightings[frame_id], self.state.depths(frame_id)
        ahead = z > 0
        if not ahead.any() or len(xy) == 0:
            return np.ones(len(xy))
        distance = ((xy[:, None] - seen.xy[ahead][None]) ** 2).sum(2)
        return z[ahead][distance.argmin(1)]

    def _add(self, in_cam: Array, seen_at: dict[int, Array]) -> None:
        """Add points (Q, 3) in the first keyframe, found by it at pixels (Q, 2) and followed into the others."""
        (first, xy), state = next(iter(seen_at.items())), self.state
        points = se3.transform(se3.inverse(state.poses[first]), in_cam)
        index = state.add_points(points, self.pictures.color(first)[xy[:, 1].astype(int), xy[:, 0].astype(int)])
        for frame_id, pixels in seen_at.items():
            is_first = frame_id == first
            extra = Sightings.of(index, pixels, FEATURE_SD if is_first else FLOW_SD, -1 if is_first else first)
            state.sightings[frame_id] = state.sightings[frame_id].joined(extra)


def _count(solved: FramePose | None) -> int:
    return 0 if solved is None else int(solved.inliers.sum())


def triangulate(
    xy1: Array, xy2: Array, cam2_from_cam1: Array, intrinsics: Intrinsics, max_error: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Points in the first camera (Q, 3) nearest to both rays, and which (Q,) are good: in front of both cameras, rays
    at an angle of at least 1.5 degrees, and within `max_error` pixels in both images."""
    ones = np.ones(len(xy1))
    ray1 = unproject(xy1, ones, intrinsics)
    centre2 = se3.inverse(cam2_from_cam1)[:3, 3]
    ray2 = unproject(xy2, ones, intrinsics) @ cam2_from_cam1[:3, :3]
    ray1 /= np.linalg.norm(ray1, axis=1, keepdims=True)
    ray2 /= np.linalg.norm(ray2, axis=1, keepdims=True)
    cosine = (ray1 * ray2).sum(1)
    t1, t2 = nearest_along(ray1, ray2, centre2, cosine)
    points = (ray1 * t1[:, None] + centre2 + ray2 * t2[:, None]) / 2
    good = (t1 > 0) & (t2 > 0) & (np.arccos(np.clip(cosine, -1, 1)) > MIN_ANGLE)
    for motion, xy in ((np.eye(4), xy1), (cam2_from_cam1, xy2)):
        seen, _ = project(se3.transform(motion, points), intrinsics)
        good &= np.nan_to_num(np.linalg.norm(seen - xy, axis=1), nan=np.inf) < max_error
    return points, good
