"""Stage 3: a pose for every frame, metric where the proxy depth is, and the sparse points that hold them together."""

from collections.abc import Collection, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.camera import rig_of
from ..run.files import (
    BACKBONE,
    CALIBRATION,
    DEPTH_FIELDS,
    FIGURES,
    FRAME_OBSERVATIONS,
    FRAMES,
    GIVEN_POSES,
    LOOPS,
    MATCHED_PAIRS,
    SPARSE,
    TRAJECTORY,
)
from ..run.stages import StageContext
from ..sfm.adjust import FEATURE_SD
from ..sfm.driver import LEAST_PIECE
from ..sfm.rolling import FILM, frame_interval
from ..system.machine import release_free_memory
from ..system.progress import is_asked
from ..system.values import load_value, save_value
from ..system.wording import stretches
from ..types import Frame
from .adjust import Report, adjust_state, align_depths, has_independent_depth, part_loose
from .front_end import FrontEnd
from .graph import reprojection_error, spread_drift
from .links import Link, LinkSearch, add_sightings
from .pnp import MAX_GAP
from .segments import carry_given, split_segments
from .state import (
    Pictures,
    TrackState,
    load_shutter,
    sparse_model_of,
    split_worlds,
    sync_rig_poses,
    to_frame_observations,
    to_trajectory,
)

SNAPSHOT_EVERY, SNAPSHOTS = 50, 20
"""Frames between two; of a long recording no more are taken in all, since each holds all that is known so far."""
_WORSE, _WORSE_PX = 1.5, 0.05
"""By how much, as a factor and in pixels, links may raise the error of what was known before."""
_LONG = 1.0
"""Seconds without a position from which a stretch is said to be filmed badly."""


def run(context: StageContext) -> dict[str, Any]:
    """Keyframes from structure from motion, every other frame against them, then everything adjusted together."""
    return TrackingStage(context).run()


class TrackingStage:
    """The steps of the stage; a `TrackState` holds the poses and points so far, `links` what joins them."""

    links: Sequence[Link] = ()

    def __init__(self, context: StageContext) -> None:
        self.context, self.config = context, context.config
        self.frames = context.run.load(FRAMES)
        self.proxy = context.run.load(FIGURES["proxy"])
        self.is_metric = bool(self.proxy.get("metric", False))
        self.pictures = Pictures(context.run, context.config.frames)

    def run(self) -> dict[str, Any]:
        """Do the stage; its key figures."""
        pictures = self.pictures
        state = self._track_frames()
        self._require_poses(state, 2 if self.context.run.find(GIVEN_POSES) is None else 1)
        report = self._adjust(state)
        report = self._link(state) or report
        release_free_memory()
        if not self.context.run.is_piece:  # of which the run around it has judged all
            part_loose(state, report, pictures.intrinsics, LEAST_PIECE)
        carried = carry_given(self.context, state)
        self._require_poses(state, 2)
        state, *pieces = split_worlds(state, LEAST_PIECE)
        self._save_pieces(pieces)
        self._save(state, report)
        figures = {**self._figures(state, report), **carried, "pieces": [len(p.poses) for p in pieces]}
        if "reference_relative_sd" in self.proxy:  # what the user's reference leaves open; depths agree far better
            figures["scale_relative_sd"] = self.proxy["reference_relative_sd"]
        self.context.save(FIGURES["tracking"], figures)
        self._warn_of_lost(state, pieces)
        return figures

    def _adjust(self, state: TrackState) -> Report:
        independent = has_independent_depth(self.proxy)
        return adjust_state(state, self.pictures.intrinsics, self.pictures.proxy, self.is_metric, independent)

    def _link(self, state: TrackState) -> Report | None:
        """Join segments and close loops, in place, and adjust everything with the links that were found; None without
        any, or where they contradict what was known before."""
        context, intrinsics, before = self.context, self.pictures.intrinsics, deepcopy(state)
        pairs, times = context.run.load(MATCHED_PAIRS), np.array([f.timestamp for f in self.frames])
        refused = {pair for pair, matches in pairs.items() if matches == 0}
        search = LinkSearch(state, self.pictures, self.config.run.seed, refused, self._near(pairs, times), times)
        joining = search.join_segments()
        loops: list[Link] = []
        if len(state.rig) == 1:  # the graph knows no places: loops of panoramas are those of structure from motion
            loops = search.loops(lambda rows: context.progress.track(rows, "loops", len(rows)))
        self.links = [*joining, *loops]
        if not self.links:
            return None
        if len(state.rig) == 1:
            spread_drift(state, self.links, intrinsics, before.segment)
        add_sightings(state, self.links)
        report = self._adjust(state)
        was, now = (reprojection_error(s, intrinsics, before.sightings) for s in (before, state))
        if now <= _WORSE * was + _WORSE_PX:
            return report
        context.warn(
            f"{len(self.links)} links between keyframes were refused: with them the reprojection error of what was "
            f"known before rises from {was:.2f} to {now:.2f} px"
        )
        self.links = []
        vars(state).update(vars(before))
        return None

    def _near(self, pairs: dict[tuple[int, int], int], times: NDArray[np.float64]) -> list[tuple[int, int]]:
        """Pairs of keyframes near each other that match; none of photos."""
        frames, numbers = self.context.run.records.get("frames"), np.array([f.source_index for f in self.frames])
        if frames is None or not frames.figures.get("timed", True) or not 0 < frame_interval(times, numbers) < FILM:
            return []
        place = {k: n for n, k in enumerate(sorted({k for pair in pairs for k in pair}))}
        reach = self.config.frames.overlap
        return [(i, j) for (i, j), matches in pairs.items() if matches and place[j] - place[i] <= reach]

    def _track_frames(self) -> TrackState:
        """Every frame visited once; goes on from the last snapshot."""
        snapshot, frames, seed = self.context.snapshot / "state.npz", self.frames, self.config.run.seed
        state: TrackState = load_value(snapshot) if snapshot.exists() else self._start_state()
        front_end = FrontEnd(state, self.pictures, seed)
        every = max(SNAPSHOT_EVERY, len(frames) // SNAPSHOTS)
        for frame in self.context.progress.track(frames[state.done :], "tracking", len(frames) - state.done):
            if frame.id not in state.poses:
                front_end.track(frame.id)
            state.done += 1
            if state.done % every == 0 or is_asked():
                save_value(snapshot, state)
        sync_rig_poses(state)
        # Frames before the first keyframe could not be followed from anywhere; now there are neighbours behind them.
        for frame_id in sorted(state.lost, reverse=True):
            front_end.track(frame_id, may_start=False)
        sync_rig_poses(state)
        return state

    def _start_state(self) -> TrackState:
        """The backbone, its parts and what structure from motion could place only among itself as segments, or
        nothing."""
        run = self.context.run
        rig, shutter = rig_of(run.load(CALIBRATION).directions, len(self.frames)), load_shutter(run)
        backbone = run.find(BACKBONE)
        if backbone is None:
            return TrackState(rig=rig, shutter=shutter)
        state = TrackState.from_backbone(backbone, FEATURE_SD, rig, shutter)
        split_segments(state)
        for piece in run.pieces("frames"):
            state.add_segment(TrackState.from_backbone(run.load(SPARSE, "frames", piece=piece), FEATURE_SD))
        return state

    def _require_poses(self, state: TrackState, least: int) -> None:
        """Raise InputError where fewer than `least` frames have a pose."""
        if len(state.poses) < least:
            raise InputError(
                f"{self.context.source}: no camera motion could be recovered from {len(self.frames)} frames. Possible "
                "causes: a camera that stands still or only turns, plain or blurred images, or wrong --intrinsics. "
                "Move the camera sideways, or choose another part"
            )

    def _save_pieces(self, pieces: list[TrackState]) -> None:
        """Write the disconnected components, each in a world and a unit of its own."""
        for number, piece in enumerate(pieces, 2):
            self.context.save(TRAJECTORY, to_trajectory(piece, self.frames), piece=f"piece_{number}")
            self.context.save(SPARSE, sparse_model_of(piece), piece=f"piece_{number}")
            self.context.warn(
                f"{len(piece.poses)} frames ({stretches(sorted(piece.poses))}) form a disconnected component: they are "
                f"exported separately, as piece_{number}"
            )

    def _save(self, state: TrackState, report: Report) -> None:
        context, model = self.context, sparse_model_of(state)
        context.save(TRAJECTORY, to_trajectory(state, self.frames))
        context.save(SPARSE, model)
        context.save(FRAME_OBSERVATIONS, to_frame_observations(state))
        context.save(LOOPS, [n.edge for n in self.links if {n.edge.frame1_id, n.frame_id} <= {*state.poses}])
        context.save(DEPTH_FIELDS, align_depths(model, report, self.pictures.intrinsics, self.pictures.proxy))

    def _figures(self, state: TrackState, report: Report) -> dict[str, Any]:
        world = report.ties.world
        return {
            "frames": len(self.frames),
            "posed": len(state.poses),
            "keyframes": len(state.keyframes),
            "lost": {str(i): reason for i, reason in sorted(state.lost.items())},
            "links": len(self.links),
            "scale": "metric" if self.is_metric and world else "free",
            "scale_relative_sd": world.relative_sd if world else None,
            **report.figures,
        }

    def _warn_of_lost(self, state: TrackState, pieces: list[TrackState]) -> None:
        lost = set(state.lost).difference(*(p.poses for p in pieces))
        if lost:
            self.context.warn(f"{len(lost)} frames have no pose: {stretches(lost)}")
        if len(state.rig) == 1:
            warn_of_stretches(self.context, self.frames, lost)


def warn_of_stretches(context: StageContext, frames: list[Frame], unplaced: Collection[int]) -> None:
    """Warn of each stretch of a film, a second or longer, in which almost no frame has a position."""
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
