"""The front end: every frame that structure from motion left out is posed against the keyframes around it."""

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..sfm.flow import FLOW_SD, follow
from .extend import promote, start_segment
from .pictures import Pictures
from .pnp import MIN_INLIERS, FramePose, predict_pose, solve_pose
from .relocalise import relocalise
from .state import NO_SIGHTINGS, Sightings, TrackState

Array = NDArray[np.float64]

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
        """Whether keyframes of one segment are on both sides: then there is no need for new ones."""
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
            promote(frame_id, self.state, self.pictures)

    def extend_before(self, frame_id: int) -> bool:
        """Make the posed frame next to this one a keyframe, where there is none ahead; whether that was possible."""
        near = [i for i in (frame_id - 1, frame_id + 1) if i in self.state.poses and i not in self.state.keyframes]
        if not near or self.is_inside(frame_id):
            return False
        promote(near[0], self.state, self.pictures)
        return True

    def _start(self, frame_id: int, start: Array | None) -> bool:
        if self.is_rig:
            return False
        pose = np.eye(4) if start is None else start
        return start_segment(frame_id, pose, self.state, self.pictures)

    def correspond(self, frame_id: int, start: Array, keyframes: list[int]) -> Sightings:
        """Points of the keyframes found in the frame by KLT, searched from where `start` (4, 4) puts them."""
        seen = NO_SIGHTINGS
        grey = self.pictures.grey(frame_id)
        for keyframe in keyframes:
            known = self.state.sightings[keyframe]
            known = known.select(~np.isin(known.point, seen.point))
            points = self.state.points[known.point]
            guess, _ = project(points @ start[:3, :3].T + start[:3, 3], self.pictures.intrinsics)
            xy, found = follow(self.pictures.grey(keyframe), grey, known.xy, guess, window=PATCH)
            found &= self.pictures.is_scene(frame_id, xy)
            seen = seen.joined(Sightings.of(known.point[found], xy[found], FLOW_SD, keyframe))
        return seen

    def solve(self, frame_id: int, seen: Sightings, start: Array | None) -> FramePose | None:
        """The pose that most of the sightings agree on."""
        points = self.state.points[seen.point]
        return solve_pose(seen.xy, points, self.pictures.intrinsics, self.seed + frame_id, start)

    def is_trusted(self, seen: Sightings, solved: FramePose | None) -> bool:
        """Enough points agree, and not by a small minority, which is how a wrong pose looks."""
        return _count(solved) >= MIN_INLIERS and _count(solved) >= 0.4 * len(seen)


def _count(solved: FramePose | None) -> int:
    return 0 if solved is None else int(solved.inliers.sum())
