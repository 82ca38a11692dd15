"""Poses for the images of the source between the picked frames: each against the keyframes around it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.video import VideoFrame
from ..config import FramesConfig
from ..frames.learned import picture_features
from ..geometry import se3
from ..geometry.camera import Rig, rig_of
from ..geometry.sparse_model import SparseModel
from ..mapping.move_map import follow_keyframes
from ..run.files import CALIBRATION, EVERY_FRAME, FEATURES, FRAMES
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..sfm.adjust import FEATURE_SD
from ..sfm.lens import distorted_camera, make_lens, to_pycolmap
from ..sfm.rolling import Shutter, velocities
from ..source.faces import find_faces
from ..source.picking import reduce_image
from ..source.recording import Recording, open_recording
from ..system.parallel import read_ahead
from ..system.progress import is_asked
from ..system.values import load_value, save_value
from ..system.wording import stretches
from ..tracking.adjust import settle
from ..tracking.front_end import FrontEnd
from ..tracking.pnp import FramePose, group_by_points, localise_in_groups, predict_pose
from ..tracking.state import NO_SIGHTINGS, Pictures, Sightings, TrackState
from ..types import Array, Features, Trajectory, any_of

Image = NDArray[np.uint8]
_SNAPSHOT_EVERY = 200
_NEIGHBOURS = 2
"""Keyframes, and picked frames, on each side by which an image is placed."""
_POINTS = 150
"""Of each of these keyframes that are looked for: with all of some 900 an image takes 93 ms and not 33 (kitchen), and
is no nearer to its true place (whiteroom_2: 0.199 and 0.19 cm off)."""
_STATIONS = 1 << 26
"""More than a source has images: image i in direction c has the number c * _STATIONS + i."""


@dataclass(frozen=True)
class Placed:
    """Image `index` of the source, its time in seconds, and its cam_from_world (4, 4), of a panorama that of the front;
    why it has none, or ""."""

    index: int
    time: float
    cam_from_world: Array
    lost: str = ""


def pose_every_frame(context: StageContext, model: SparseModel, trajectory: Trajectory) -> dict[str, Any]:
    """Pose the images of the source between the picked frames, write EVERY_FRAME, and return key figures: none where
    every image was picked, or the source can no longer be read, which is warned of.

    Keyframes and the other picked frames are where `trajectory` has them; points, and where keyframes see them, are
    those of `model`. Each image is placed by itself, so that an interruption changes nothing.
    """
    settings = context.config
    if settings.global_ba.posed == "picked" or settings.frames.rate == 0:
        return {}
    try:
        source = open_recording(context.source, settings.run.format)
        if not source.is_timed():
            return {}
        context.same_source()
        placed = place_all(context, source, Placer(context, model, trajectory))
    except InputError as error:
        context.warn(f"only the picked frames have a pose, the images between could not be read: {error}")
        return {}
    if not placed:
        return {}
    if lost := [p.index for p in placed if p.lost]:
        context.warn(
            f"{len(lost)} of {len(placed)} images between the picked frames have no pose (counted from 0 in the "
            f"source: {stretches(lost)})"
        )
    every = with_placed(context.run, trajectory, placed)
    context.save(EVERY_FRAME, every)
    return {"images": len(every.frame_ids), "images_posed": int(every.is_posed.sum())}


def with_placed(run: RunFolder, trajectory: Trajectory, placed: list[Placed]) -> Trajectory:
    """The picked frames of a trajectory (of panoramas their fronts) and the images placed between, in order; frame_ids
    count the images of the source."""
    frames = run.load(FRAMES)
    t, own = trajectory, slice(0, min(rig_of(run.load(CALIBRATION).directions, len(frames)).stations, len(frames)))
    index = np.array([f.source_index for f in frames[own]] + [p.index for p in placed])
    order, none = np.argsort(index, kind="stable"), np.zeros(len(placed), np.bool_)
    reasons = [*t.lost_reasons[own], *(p.lost for p in placed)]
    return Trajectory(
        index[order],
        np.concatenate([t.timestamps[own], [p.time for p in placed]])[order],
        np.concatenate([t.cam_from_world[own], [p.cam_from_world for p in placed]])[order],
        np.concatenate([t.is_keyframe[own], none])[order],
        tuple(reasons[i] for i in order),
    )


def place_all(context: StageContext, source: Recording, placer: Placer) -> list[Placed]:
    """Place the images that were not picked, in order; goes on from the last snapshot."""
    snapshot = context.snapshot / "between.npz"
    placed: list[Placed] = load_value(snapshot) if snapshot.exists() else []
    done = placer.picked | {p.index for p in placed}
    left = max(source.expected_frames - len(done), 0)
    cut = read_ahead(_cut(context, source, done), context.threads)
    for picture, images in context.progress.track(cut, "frames between", left or None):
        if (found := placer.place(picture.source_index, picture.timestamp, images)) is not None:
            placed.append(found)
            if len(placed) % _SNAPSHOT_EVERY == 0 or is_asked():
                save_value(snapshot, placed)
    return placed


def _cut(context: StageContext, source: Any, done: set[int]) -> Iterator[tuple[VideoFrame, list[Image]]]:
    """The images that are not done, each as the undistorted frames that it would have become."""

    class Wanted:
        def __contains__(self, number: object) -> bool:
            return number not in done

    side, faces = context.config.frames.max_side, find_faces(source, context.config.frames)
    lens = make_lens(to_pycolmap(distorted_camera(context.run.load(CALIBRATION))))
    for picture in source.read(Wanted()):
        if faces is not None and len(faces) > 1:
            yield picture, faces.cut(picture.rgb)
        else:
            reduced = reduce_image(picture.rgb, side)
            yield picture, [reduced if lens.is_straight else lens.undistort_image(reduced)]


class SourcePictures(Pictures):
    """Pictures by their numbers in the source; `at_hand` are those that are no frames of the run, and `around` each of
    them are such frames."""

    def __init__(self, run: RunFolder, settings: FramesConfig, numbers: list[int]) -> None:
        super().__init__(run, settings)
        self.frames = {number: self.frames[i] for i, number in enumerate(numbers)}
        self.at_hand: dict[int, Image] = {}
        self.around: dict[int, list[int]] = {}

    def color(self, frame_id: int) -> Image:
        """(H, W, 3) RGB."""
        return self.at_hand[frame_id] if frame_id in self.at_hand else super().color(frame_id)

    def left_out(self, frame_id: int) -> NDArray[np.bool_] | None:
        """(H, W) what is no part of the scene, None where all of it is; of a picture at hand what of no frame around it
        is."""
        around = self.around[frame_id] if frame_id in self.at_hand else [frame_id]
        return any_of(super(SourcePictures, self).left_out(i) for i in around)

    def _load_features(self, frame_id: int) -> Features:
        frame = self.frames.get(frame_id)
        kept = None if frame is None else self.run.find(FEATURES, of=frame.id)
        if kept is not None:
            return kept
        return picture_features(self.color(frame_id), self.left_out(frame_id), self.settings, self._learned)


class Placer:
    """Poses images between the picked frames, each by itself, as tracking poses a frame between two keyframes."""

    def __init__(self, context: StageContext, model: SparseModel, trajectory: Trajectory) -> None:
        run, config, t = context.run, context.config, trajectory
        frames, self.calibration = run.load(FRAMES), run.load(CALIBRATION)
        around = RunFolder(run.root.parent).load(FRAMES) if run.is_piece else frames
        rig = rig_of(self.calibration.directions, len(frames))
        numbers = [f.source_index + f.id // rig.stations * _STATIONS for f in frames]
        self.picked = {f.source_index for f in around}
        self._in_order = np.array(sorted(self.picked))
        self.lost = {n: why for n, why in zip(numbers, t.lost_reasons, strict=True) if why}
        self._times = dict(zip(numbers, t.timestamps.tolist(), strict=True))
        # The points are where structure from motion and loops have put them; mapping may have moved keyframes since.
        ids = np.array(numbers, np.int64)
        self._keyframes = ids[np.searchsorted(t.frame_ids, model.frame_ids)]
        self._final = t.cam_from_world[np.searchsorted(t.frame_ids, model.frame_ids)]
        self._fitted = model.cam_from_world
        known = t.is_posed
        poses = self._follow(ids[known], t.cam_from_world[known], self._final, self._fitted)
        self._poses = dict(zip(ids[known].tolist(), poses, strict=True))
        self._posed = np.array(sorted(self._poses), np.int64)
        self.rig = Rig(_STATIONS, rig.cam_from_rig)
        self.state = TrackState.from_backbone(model, FEATURE_SD, self.rig, Shutter(self.calibration.readout))
        for name in ("poses", "sightings", "segment"):
            setattr(self.state, name, {numbers[i]: value for i, value in getattr(self.state, name).items()})
        self.state.keyframes = [numbers[k] for k in self.state.keyframes]
        self.pictures = SourcePictures(run, config.frames, numbers)
        self.front_end, self.seed = FrontEnd(self.state, self.pictures, config.run.seed), config.run.seed

    def place(self, index: int, time: float, images: list[Image]) -> Placed | None:
        """Place image `index`, seen in each direction; None where it is beside no frame of this run."""
        at = int(np.searchsorted(self._in_order, index))
        around = [i for i in self._in_order[max(at - 1, 0) : at + 1].tolist() if i in self._times]
        if not around:
            return None
        if all(i in self.lost for i in around):
            return Placed(index, time, np.eye(4), self.lost[around[0]])
        self.pictures.at_hand = {c * _STATIONS + index: image for c, image in enumerate(images)}
        self.pictures.around = {n: [n - index + i for i in around] for n in self.pictures.at_hand}
        found = [(number, *self._find(number, time)) for number in self.pictures.at_hand]
        number, seen, solved = max(found, key=lambda f: 0 if f[2] is None else int(f[2].inliers.sum()))
        if solved is None or not self.front_end.is_trusted(seen, solved):
            return Placed(index, time, np.eye(4), f"{len(seen)} points found again, too few of them agree on a pose")
        pose = self._settled(number, time, seen.select(solved.inliers), solved.cam_from_world)
        pose = self._follow(np.array([number]), pose[None], self._fitted, self._final)[0]
        return Placed(index, time, se3.inverse(self.rig.motions[number // _STATIONS]) @ pose)

    def _find(self, number: int, time: float) -> tuple[Sightings, FramePose | None]:
        """Sightings, and the pose they agree on: by flow from the keyframes around, else by their features."""
        around = self._poses_around(number)
        start = predict_pose(number, around, {**{i: self._times[i] for i in around}, number: time})
        near = self.state.nearest_keyframes(number, _NEIGHBOURS)
        near = [k for k in near if k // _STATIONS == number // _STATIONS]
        seen, solved = NO_SIGHTINGS, None
        if start is not None and near:
            seen = self.front_end.correspond(number, start, near, _POINTS)
            solved = self.front_end.solve(number, seen, start)
        if near and not self.front_end.is_trusted(seen, solved):
            return localise_in_groups(number, group_by_points(near, self.state), self.state, self.pictures, self.seed)
        return seen, solved

    def _settled(self, number: int, time: float, seen: Sightings, pose: Array) -> Array:
        """The pose adjusted to what is seen, but for the errors of the keyframes' pixels and a rolling shutter."""
        velocity: dict[int, Array] = {}
        if self.state.shutter.is_rolling:
            around = self._poses_around(number) | {number: pose}
            ids = sorted(around)
            times = np.array([self._times.get(i, time) for i in ids])
            own = velocities(np.array([around[i] for i in ids]), times)[ids.index(number)]
            velocity = self._velocities | {number: own}
        self.state.add_frame(number, pose, seen, False, 0)
        settle(number, self.state, self.calibration.intrinsics, velocity)
        settled = self.state.poses[number]
        self.state.remove_frame(number)
        return settled

    @cached_property
    def _velocities(self) -> dict[int, Array]:
        times = np.array([self._times[i] for i in self._posed.tolist()])
        of_posed = velocities(np.array([self._poses[i] for i in self._posed.tolist()]), times)
        return dict(zip(self._posed.tolist(), of_posed, strict=True))

    def _poses_around(self, number: int) -> dict[int, Array]:
        """Poses of the picked frames around, in the same direction."""
        at = int(np.searchsorted(self._posed, number))
        near = self._posed[max(at - _NEIGHBOURS, 0) : at + _NEIGHBOURS].tolist()
        return {i: self._poses[i] for i in near if i // _STATIONS == number // _STATIONS}

    def _follow(self, numbers: NDArray[np.int64], poses: Array, old: Array, new: Array) -> Array:
        """(F, 4, 4) poses after the keyframes moved from old to new ones."""
        return follow_keyframes(numbers, poses, self._keyframes, old, new, np.ones(len(old)))
