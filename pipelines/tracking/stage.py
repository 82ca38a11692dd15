"""Stage 3: a pose for every frame, metric where the proxy depth is, and the sparse points that hold them together."""

from collections.abc import Collection
from typing import Any

import numpy as np

from ...formats.errors import InputError
from ..geometry.camera import Rig, rig_of
from ..run.files import (
    BACKBONE,
    CALIBRATION,
    DEPTH_FIELDS,
    FIGURES,
    FRAME_OBSERVATIONS,
    FRAMES,
    GIVEN_POSES,
    SPARSE,
    TRAJECTORY,
)
from ..run.stages import StageContext
from ..sfm.adjust import FEATURE_SD
from ..sfm.rolling import Shutter
from ..system.machine import release_free_memory
from ..system.progress import is_asked
from ..system.values import load_value, save_value
from ..system.wording import stretches
from ..types import Frame
from .adjust import Report, adjust_state, align_depths, drop_loose, without_dependent_depth
from .front_end import FrontEnd, set_rotation_only_poses
from .pictures import Pictures, load_shutter
from .pnp import MAX_GAP
from .segments import carry_given, join_segments, split_segments
from .state import (
    TrackState,
    sparse_model_of,
    split_worlds,
    sync_rig_poses,
    to_frame_observations,
    to_trajectory,
)

SNAPSHOT_EVERY, SNAPSHOTS = 50, 20
"""Frames between two; of a long recording no more are taken in all, since each holds all that is known so far."""
_LONG = 1.0
"""Seconds without a position from which a stretch is said to be filmed badly."""


def run(context: StageContext) -> dict[str, Any]:
    """Keyframes from structure from motion, every other frame against them, then everything adjusted together."""
    frames = context.run.load(FRAMES)
    proxy = context.run.load(FIGURES["proxy"])
    settings = without_dependent_depth(context.config.tracking, proxy)
    metric = bool(proxy.get("metric", False))
    pictures = Pictures(context.run, context.config.frames)
    intrinsics = pictures.intrinsics

    state = track_frames(context, frames, pictures)
    require_poses(context, state, frames, 2 if context.run.find(GIVEN_POSES) is None else 1)
    report = adjust_state(state, intrinsics, pictures.proxy, metric, settings)
    release_free_memory()
    _, apart = drop_loose(state, report, intrinsics, context.config.frames.least_piece)
    carried = carry_given(context, state, apart)
    require_poses(context, state, frames, 2)
    set_rotation_only_poses(state, pictures, context.config.run.seed)
    if state.turned:
        context.warn(
            f"{len(state.turned)} frames ({stretches(state.turned)}) are posed by rotation alone: their orientation "
            "relative to neighbouring frames is known, their position is not"
        )
    state, *pieces = split_worlds(state, context.config.frames.least_piece)
    save_pieces(context, pieces, frames)

    trajectory = to_trajectory(state, frames)
    TRAJECTORY.save(context.folder, trajectory)
    model = sparse_model_of(state)
    SPARSE.save(context.folder, model)
    FRAME_OBSERVATIONS.save(context.folder, to_frame_observations(state))
    DEPTH_FIELDS.save(context.folder, align_depths(model, report, intrinsics, pictures.proxy))
    figures = {**stage_figures(state, frames, report, metric), **carried}
    figures["pieces"] = [len(p.poses) for p in pieces]
    if "reference_relative_sd" in proxy:  # what the user's reference leaves open; depths agree far better
        figures["scale_relative_sd"] = proxy["reference_relative_sd"]
    FIGURES["tracking"].save(context.folder, figures)
    lost = set(state.lost).difference(*(p.poses for p in pieces))
    if lost:
        context.warn(f"{len(lost)} frames have no pose: {stretches(lost)}")
    if len(state.rig) == 1:
        warn_of_stretches(context, frames, lost.union(state.turned, *(p.turned for p in pieces)))
    return figures


def warn_of_stretches(context: StageContext, frames: list[Frame], unplaced: Collection[int]) -> None:
    """Warn of each stretch of a film, a second or longer, in which hardly a frame has a position."""
    times = {f.id: f.timestamp for f in frames}
    if len(frames) < 2 or float(np.median(np.diff(sorted(times.values())))) >= _LONG:  # photographs
        return
    ids = np.array(sorted(unplaced), np.int64)
    for run in np.split(ids, np.flatnonzero(np.diff(ids) > MAX_GAP) + 1):
        if len(run) and times[run[-1]] - times[run[0]] >= _LONG:
            context.warn(
                f"from {times[run[0]]:.1f} to {times[run[-1]]:.1f} s (frames {run[0]}-{run[-1]}) almost no frame "
                "could be located: the camera stood still, only turned, or saw too little, such as a bare wall. Film "
                "that part again while walking, with something textured in view"
            )


def require_poses(context: StageContext, state: TrackState, frames: list[Frame], least: int) -> None:
    """Raise InputError where fewer than `least` frames have a pose."""
    if len(state.poses) < least:
        raise InputError(
            f"{context.source}: no camera motion could be recovered from {len(frames)} frames. Possible causes: a "
            "camera that stands still or only turns, plain or blurred images, or wrong --intrinsics. "
            "Move the camera sideways, or choose another part"
        )


def track_frames(context: StageContext, frames: list[Frame], pictures: Pictures) -> TrackState:
    """Every frame visited once; goes on from the last snapshot."""
    snapshot = context.snapshot / "state.npz"
    rig = rig_of(context.run.load(CALIBRATION).directions, len(frames))
    shutter = load_shutter(context.run)
    state: TrackState = load_value(snapshot) if snapshot.exists() else start_state(context, rig, shutter)
    front_end = FrontEnd(state, pictures, context.config.run.seed)
    every = max(SNAPSHOT_EVERY, len(frames) // SNAPSHOTS)
    for frame in context.progress.track(frames[state.done :], "tracking", len(frames) - state.done):
        if frame.id not in state.poses:
            front_end.track(frame.id)
        state.done += 1
        if state.done % every == 0 or is_asked():
            save_value(snapshot, state)
    sync_rig_poses(state)
    # Frames before the first keyframe could not be followed from anywhere; now there are neighbours behind them.
    for frame_id in sorted(state.lost, reverse=True):
        front_end.track(frame_id, may_start=False)
    join_segments(state, pictures, context.config.run.seed)
    sync_rig_poses(state)
    return state


def start_state(context: StageContext, rig: Rig, shutter: Shutter) -> TrackState:
    """The backbone, its parts and what structure from motion could place only among itself as segments, or nothing."""
    backbone = context.run.find(BACKBONE)
    if backbone is None:
        return TrackState(rig=rig, shutter=shutter)
    state = TrackState.from_backbone(backbone, FEATURE_SD, rig, shutter)
    split_segments(state)
    for piece in context.run.pieces("frames"):
        state.add_segment(TrackState.from_backbone(context.run.load(SPARSE, "frames", piece=piece), FEATURE_SD))
    return state


def save_pieces(context: StageContext, pieces: list[TrackState], frames: list[Frame]) -> None:
    """Write the disconnected components, each in a world and a unit of its own."""
    for number, piece in enumerate(pieces, 2):
        folder = context.folder / f"piece_{number}"
        TRAJECTORY.save(folder, to_trajectory(piece, frames))
        SPARSE.save(folder, sparse_model_of(piece))
        context.warn(
            f"{len(piece.poses)} frames ({stretches(sorted(piece.poses))}) form a disconnected component: they are "
            f"exported separately, as piece_{number}"
        )


def stage_figures(state: TrackState, frames: list[Frame], report: Report, metric: bool) -> dict[str, Any]:
    """Return the stage's key figures, by name."""
    world = report.ties.world
    return {
        "frames": len(frames),
        "posed": len(state.poses),
        "keyframes": len(state.keyframes),
        "by_rotation": len(state.turned),
        "lost": {str(i): reason for i, reason in sorted(state.lost.items())},
        "scale": "metric" if metric and world else "free",
        "scale_relative_sd": world.relative_sd if world else None,
        **report.figures,
    }
