"""State of tracking: poses, points, and which frame sees which point where; and the pictures of frames, the last few
kept in memory."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.images import to_grey
from ..config import FramesConfig
from ..frames.learned import open_learned, picture_features
from ..geometry import se3
from ..geometry.camera import ONE_CAMERA, Rig
from ..geometry.sparse_model import FrameObservations, SparseModel
from ..run.files import CALIBRATION, FEATURES, FRAMES, VOCABULARY
from ..run.folder import RunFolder
from ..sfm.features import global_descriptor
from ..sfm.rolling import Shutter, velocities
from ..types import Array, Features, Frame, ProxyMaps, Trajectory


@dataclass(frozen=True)
class Sightings:
    """Points seen by one frame: point (Q,) indices, xy (Q, 2) pixels, sd (Q,) their standard deviation in pixels.

    source (Q,) is the frame from whose sighting of the point each was followed, -1 where it was found by itself. One
    that was followed inherits the error of its source: its `sd` is of the motion between the two.
    """

    point: NDArray[np.int64]
    xy: Array
    sd: Array
    source: NDArray[np.int64]

    @staticmethod
    def of(point: NDArray[np.int64], xy: Array, sd: float, source: int = -1) -> Sightings:
        """Sightings that are equally exact, all found by themselves or followed from one frame."""
        return Sightings(point, xy, np.full(len(point), sd), np.full(len(point), source))

    def __len__(self) -> int:
        return len(self.point)

    def select(self, keep: NDArray) -> Sightings:
        """Select sightings by a mask or by indices."""
        return Sightings(self.point[keep], self.xy[keep], self.sd[keep], self.source[keep])

    def points_at(self, xy: Array) -> NDArray[np.int64]:
        """(F,) the point that is seen within 2 px of each of the pixels (F, 2), -1 for none."""
        if not len(self):
            return np.full(len(xy), -1, np.int64)
        distance, nearest = cKDTree(self.xy).query(xy, distance_upper_bound=_SNAP_PX)
        return np.where(np.isfinite(distance), self.point[np.minimum(nearest, len(self) - 1)], -1)

    def joined(self, other: Sightings) -> Sightings:
        """Both, this one's first."""
        return Sightings(
            np.concatenate([self.point, other.point]),
            np.concatenate([self.xy, other.xy]),
            np.concatenate([self.sd, other.sd]),
            np.concatenate([self.source, other.source]),
        )


_NEAR_KEYFRAMES = 8
_SNAP_PX = 2.0
"""A feature within so many pixels of a frame's sighting is the same point."""
_COMPARED_TOGETHER = 64
"""Keyframes whose descriptors are in memory in full precision."""
NO_SIGHTINGS = Sightings.of(np.zeros(0, np.int64), np.zeros((0, 2)), 1.0)


@dataclass
class TrackState:
    """points (P, 3) in the world, colors (P, 3); per frame id its pose cam_from_world, its sightings or why it is lost.

    `segment` numbers connected stretches: poses of different segments cannot be compared. `done` counts the frames that
    have been visited; `rig` says which frames were taken at one place, `shutter` how their rows were.
    """

    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    colors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    poses: dict[int, Array] = field(default_factory=dict)
    sightings: dict[int, Sightings] = field(default_factory=dict)
    keyframes: list[int] = field(default_factory=list)
    lost: dict[int, str] = field(default_factory=dict)
    segment: dict[int, int] = field(default_factory=dict)
    done: int = 0
    rig: Rig = ONE_CAMERA
    shutter: Shutter = field(default_factory=Shutter)

    @staticmethod
    def from_backbone(
        model: SparseModel, sd: float, rig: Rig = ONE_CAMERA, shutter: Shutter | None = None
    ) -> TrackState:
        """Take the keyframes and points of structure from motion as segment 0."""
        state = TrackState(model.points_in_world.copy(), model.colors.copy(), rig=rig, shutter=shutter or Shutter())
        for k, frame_id in enumerate(int(i) for i in model.frame_ids):
            mine = model.observations_of(k)
            seen = Sightings.of(model.obs_point[mine].astype(np.int64), model.obs_xy[mine], sd)
            state.add_frame(frame_id, model.cam_from_world[k], seen, is_keyframe=True, segment=0)
        return state

    def add_frame(
        self, frame_id: int, cam_from_world: Array, sightings: Sightings, is_keyframe: bool, segment: int
    ) -> None:
        """Add a posed frame; its sightings count each point once."""
        _, first = np.unique(sightings.point, return_index=True)
        self.poses[frame_id] = np.asarray(cam_from_world, dtype=np.float64)
        self.sightings[frame_id] = sightings.select(np.sort(first))
        self.segment[frame_id] = segment
        self.lost.pop(frame_id, None)
        if is_keyframe:
            place = bisect_left(self.keyframes, frame_id)
            if self.keyframes[place : place + 1] != [frame_id]:
                self.keyframes.insert(place, frame_id)

    def remove_frame(self, frame_id: int) -> None:
        """Remove a posed frame; its points stay."""
        for table in (self.poses, self.sightings, self.segment):
            del table[frame_id]
        if frame_id in self.keyframes:
            self.keyframes.remove(frame_id)

    def add_segment(self, other: TrackState) -> None:
        """Add the keyframes of another world that are not posed yet, with their points, as a segment of their own."""
        first = self.add_points(other.points, other.colors)[:1]
        segment = max(self.segment.values(), default=-1) + 1
        for k in (k for k in other.keyframes if k not in self.poses):
            seen = other.sightings[k]
            self.add_frame(k, other.poses[k], replace(seen, point=seen.point + first), True, segment)

    def detach(self, frame_ids: Collection[int]) -> None:
        """Make frames a segment of their own, which shares no point with another."""
        elsewhere = np.concatenate([seen.point for i, seen in self.sightings.items() if i not in frame_ids])
        segment = max(self.segment.values()) + 1
        for i in frame_ids:
            self.segment[i] = segment
            self.sightings[i] = self.sightings[i].select(~np.isin(self.sightings[i].point, elsewhere))

    def add_points(self, points: Array, colors: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Add points and return their indices (Q,)."""
        first = len(self.points)
        self.points = np.concatenate([self.points, points])
        self.colors = np.concatenate([self.colors, colors])
        return np.arange(first, len(self.points))

    def segment_of_point(self, point: int, frame_id: int) -> int:
        """Return the segment of the keyframes that see a point; `frame_id` is near them, as a rule."""
        nearest = self.nearest_keyframes(frame_id, _NEAR_KEYFRAMES)
        return next(self.segment[k] for k in chain(nearest, self.keyframes) if point in self.sightings[k].point)

    def shared_sightings(self, frame_ids: Sequence[int]) -> tuple[NDArray[np.int64], Sightings]:
        """Return the sightings of these frames, one frame's after the other's, of points that at least two of them see;
        and (O,) which of the frames each is of."""
        rows = [self.sightings[i] for i in frame_ids]
        row = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
        seen = Sightings(*(np.concatenate([getattr(r, f.name) for r in rows]) for f in fields(Sightings)))
        keep = np.bincount(seen.point, minlength=len(self.points))[seen.point] >= 2
        return row[keep], seen.select(keep)

    def segment_sizes(self) -> dict[int, int]:
        """Return segment → number of posed frames, the largest first, of two alike the one of the smaller number."""
        return dict(sorted(Counter(self.segment.values()).items(), key=lambda item: (-item[1], item[0])))

    def velocities(self) -> dict[int, Array]:
        """Return by posed frame (6,) twists a second."""
        ids = sorted(self.poses)
        poses, worlds = np.array([self.poses[i] for i in ids]), np.array([self.segment[i] for i in ids])
        return dict(zip(ids, velocities(poses, self.shutter.times[ids], worlds), strict=True))

    def depths(self, frame_id: int) -> Array:
        """(Q,) depth in a frame of each point that it sees."""
        motion = self.poses[frame_id]
        return self.points[self.sightings[frame_id].point] @ motion[2, :3] + motion[2, 3]

    def median_depth(self, frame_id: int) -> float:
        """Return the median depth of the points that a frame sees; 1 when it sees none."""
        depth = self.depths(frame_id)
        return float(np.median(depth)) if len(depth) else 1.0

    def nearest_keyframes(self, frame_id: int, count: int) -> list[int]:
        """Return up to `count` keyframes on each side in time, nearest first."""
        place, behind = bisect_left(self.keyframes, frame_id), bisect_right(self.keyframes, frame_id)
        before, after = self.keyframes[max(place - count, 0) : place], self.keyframes[behind : behind + count]
        return sorted(before + after, key=lambda k: (abs(k - frame_id), k))


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


def split_worlds(state: TrackState, least: int) -> list[TrackState]:
    """Return the segments, largest first, each in a world of its own that begins with its first posed camera; of those
    after the first, the ones of at least so many frames. The first has the reason why a frame is in none or in
    another."""
    counts = state.segment_sizes()
    order = list(counts)
    kept = order[:1] + [s for s in order[1:] if counts[s] >= least]
    elsewhere = {s: f"in piece_{n}, which is not connected to the rest" for n, s in enumerate(kept[1:], 2)}
    short = "tracked, but this stretch could not be joined to the rest"
    apart = {i: elsewhere.get(s, short) for i, s in state.segment.items() if s != order[0]}
    first, *pieces = (_in_own_world(state, segment) for segment in kept)
    return [replace(first, lost=state.lost | apart), *pieces]


def _in_own_world(state: TrackState, segment: int) -> TrackState:
    inside = [i for i in sorted(state.poses) if state.segment[i] == segment]
    new_from_old = state.poses[inside[0]]
    old_from_new = se3.inverse(new_from_old)
    return TrackState(
        state.points @ new_from_old[:3, :3].T + new_from_old[:3, 3],
        state.colors,
        {i: state.poses[i] @ old_from_new for i in inside},
        {i: state.sightings[i] for i in inside},
        [k for k in state.keyframes if state.segment[k] == segment],
        segment=dict.fromkeys(inside, segment),
        rig=state.rig,
        shutter=state.shutter,
    )


def to_trajectory(state: TrackState, frames: list[Frame]) -> Trajectory:
    """Return all frames, posed or with the reason why not."""
    keyframes = set(state.keyframes)
    return Trajectory(
        frame_ids=np.array([f.id for f in frames], np.int64),
        timestamps=np.array([f.timestamp for f in frames]),
        cam_from_world=np.array([state.poses.get(f.id, np.eye(4)) for f in frames]),
        is_keyframe=np.array([f.id in keyframes for f in frames]),
        lost_reasons=tuple("" if f.id in state.poses else state.lost.get(f.id, "not tracked") for f in frames),
    )


def sparse_model_of(state: TrackState) -> SparseModel:
    """Keyframes and the points that at least two of them see."""
    cam, seen = state.shared_sightings(state.keyframes)
    used, renumbered = np.unique(seen.point, return_inverse=True)
    return SparseModel(
        np.array(state.keyframes, np.int64),
        np.array([state.poses[k] for k in state.keyframes]),
        state.points[used],
        state.colors[used],
        cam.astype(np.int64),
        renumbered.astype(np.int64),
        seen.xy,
    )


def to_frame_observations(state: TrackState) -> FrameObservations:
    """Return where the posed frames that are no keyframes see the points of `sparse_model_of`."""
    used = np.unique(state.shared_sightings(state.keyframes)[1].point)
    frames = sorted(set(state.poses).difference(state.keyframes))
    seen = [state.sightings[i] for i in frames]
    frame_id = np.repeat(np.array(frames, np.int64), [len(s) for s in seen])
    point = np.concatenate([np.zeros(0, np.int64), *(s.point for s in seen)])
    xy = np.concatenate([np.zeros((0, 2)), *(s.xy for s in seen)])
    kept = np.isin(point, used)
    return FrameObservations(frame_id[kept], np.searchsorted(used, point[kept]), xy[kept].astype(np.float32))


def load_shutter(run: RunFolder) -> Shutter:
    """Load the readout and the times of a run's frames."""
    return Shutter(run.load(CALIBRATION).readout, np.array([f.timestamp for f in run.load(FRAMES)]))


class Pictures:
    """Everything tracking looks up by frame id, and the camera. Memory does not grow with the number of frames, and by
    16 KB with each keyframe that is compared with another frame."""

    def __init__(self, run: RunFolder, settings: FramesConfig, kept: int = 12) -> None:
        self.run, self.settings = run, settings
        self.vocabulary = run.load(VOCABULARY)
        self.frames: dict[int, Frame] = {f.id: f for f in run.load(FRAMES)}
        self.intrinsics = run.load(CALIBRATION).intrinsics
        self._learned = open_learned(settings)
        self._grey = lru_cache(kept)(lambda i: to_grey(self.color(i)))
        self._left_out = lru_cache(kept)(lambda i: run.left_out(self.frames[i]))
        self._features = lru_cache(4 * kept)(self._load_features)
        # 64 x 128 numbers each. All are asked for again and again in order: of a part of them none would ever be there.
        self._descriptors: dict[int, NDArray[np.float16]] = {}

    def color(self, frame_id: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        return self.run.image(self.frames[frame_id])

    def grey(self, frame_id: int) -> NDArray[np.uint8]:
        """Return a frame in grey (H, W)."""
        return self._grey(frame_id)

    def left_out(self, frame_id: int) -> NDArray[np.bool_] | None:
        """(H, W) what is no part of the scene; None where all of it is."""
        return self._left_out(frame_id)

    def is_scene(self, frame_id: int, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(Q,) whether pixels (Q, 2) show the scene; also where they are not finite."""
        left_out = self.left_out(frame_id)
        if left_out is None:
            return np.ones(len(xy), bool)
        column, row = np.nan_to_num(xy, nan=-1.0).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < left_out.shape[1]) & (row < left_out.shape[0])
        return ~(inside & left_out[np.where(inside, row, 0), np.where(inside, column, 0)])

    def features(self, frame_id: int) -> Features:
        """Features: those that structure from motion had, of other frames new ones."""
        return self._features(frame_id)

    def _load_features(self, frame_id: int) -> Features:
        kept = self.run.find(FEATURES, of=frame_id)
        if kept is not None:
            return kept
        return picture_features(self.color(frame_id), self.left_out(frame_id), self.settings, self._learned)

    def descriptor(self, frame_id: int) -> NDArray[np.float32]:
        """Compute the global descriptor (D,) of a frame, for retrieval."""
        return global_descriptor(self.features(frame_id), self.vocabulary)

    def descriptors(self, keyframes: Sequence[int]) -> NDArray[np.float16]:
        """Return the global descriptors (K, D) of keyframes, which are kept."""
        for k in keyframes:
            if k not in self._descriptors:
                self._descriptors[k] = self.descriptor(k).astype(np.float16)
        return np.array([self._descriptors[k] for k in keyframes]).reshape(len(keyframes), -1)

    def similarities(self, descriptors: NDArray[np.floating], keyframes: Sequence[int]) -> NDArray[np.float32]:
        """Compute how alike frames of global descriptors (F, D) look to keyframes: (F, K), by chance 0."""
        ours, out = descriptors.astype(np.float32), np.empty((len(descriptors), len(keyframes)), np.float32)
        for first in range(0, len(keyframes), _COMPARED_TOGETHER):
            some = slice(first, first + _COMPARED_TOGETHER)
            out[:, some] = ours @ self.descriptors(keyframes[some]).astype(np.float32).T
        return out

    def proxy(self, frame_id: int) -> ProxyMaps | None:
        """Proxy maps where the frame has any."""
        return self.run.find_proxy(frame_id)
