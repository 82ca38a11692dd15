"""The front end: every frame that structure from motion left out is posed against the keyframes around it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipelines.config import TrackingConfig
from pipelines.geometry.camera import project
from pipelines.tracking.klt import follow
from pipelines.tracking.motion import predict_pose
from pipelines.tracking.pictures import Pictures
from pipelines.tracking.pnp import FramePose, solve_pose
from pipelines.tracking.relocalise import relocalise
from pipelines.tracking.state import NO_SIGHTINGS, Sightings, TrackState
from pipelines.types import Intrinsics

Array = NDArray[np.float64]


class FrontEnd:
    """Poses frames one after the other, in the order of their ids, into a `TrackState`."""

    def __init__(
        self,
        state: TrackState,
        pictures: Pictures,
        times: Mapping[int, float],
        intrinsics: Intrinsics,
        settings: TrackingConfig,
        seed: int,
    ) -> None:
        self.state, self.pictures, self.times = state, pictures, times
        self.intrinsics, self.settings, self.seed = intrinsics, settings, seed

    def track(self, frame_id: int) -> None:
        """Pose one frame, or note why it is lost."""
        start = predict_pose(frame_id, self.state.poses, self.times)
        seen, solved, reason = NO_SIGHTINGS, None, "nothing before it is posed"
        if start is not None:
            seen = self.correspond(frame_id, start, self.state.nearest_keyframes(frame_id, 2))
            solved = self.solve(frame_id, seen, start)
            reason = f"{len(seen)} points followed from its keyframes, {_count(solved)} agree on a pose"
        if not self.is_trusted(seen, solved):
            seen, solved = relocalise(frame_id, self.state, self.pictures, self.intrinsics, self.settings, self.seed)
            reason += f"; {len(seen)} matched in similar keyframes, {_count(solved)} agree"
        if solved is not None and self.is_trusted(seen, solved):
            segment = self.state.segment[self.state.nearest_keyframes(frame_id, 1)[0]]
            self.state.add_frame(frame_id, solved.cam_from_world, seen.select(solved.inliers), False, segment)
        else:
            self.state.lost[frame_id] = reason

    def correspond(self, frame_id: int, start: Array, keyframes: list[int]) -> Sightings:
        """Points of the keyframes found in the frame by KLT, searched from where `start` (4, 4) puts them."""
        seen = NO_SIGHTINGS
        grey = self.pictures.grey(frame_id)
        for keyframe in keyframes:
            known = self.state.sightings[keyframe]
            known = known.select(~np.isin(known.point, seen.point))
            points = self.state.points[known.point]
            guess, _ = project(points @ start[:3, :3].T + start[:3, 3], self.intrinsics)
            s = self.settings
            xy, found = follow(
                self.pictures.grey(keyframe), grey, known.xy, guess, s.flow_window, s.flow_levels, s.flow_error
            )
            seen = seen.joined(Sightings(known.point[found], xy[found], np.full(int(found.sum()), s.flow_sd)))
        return seen

    def solve(self, frame_id: int, seen: Sightings, start: Array | None) -> FramePose | None:
        """The pose that most of the sightings agree on."""
        points = self.state.points[seen.point]
        return solve_pose(seen.xy, points, self.intrinsics, self.seed + frame_id, start, self.settings.pose_error)

    def is_trusted(self, seen: Sightings, solved: FramePose | None) -> bool:
        """Enough points agree, and not by a small minority, which is how a wrong pose looks."""
        return _count(solved) >= self.settings.min_inliers and _count(solved) >= 0.4 * len(seen)


def _count(solved: FramePose | None) -> int:
    return 0 if solved is None else int(solved.inliers.sum())
