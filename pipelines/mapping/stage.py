"""Stage 4: the semantic Gaussian map from the keyframes (MSGS-SLAM 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.engine.stages import Stage, StageContext
from msgs_slam.pipelines.mapping.divided import Mapped, map_divided
from msgs_slam.pipelines.mapping.load import load_views, split_frames, survey, with_rigid_panoramas
from msgs_slam.pipelines.mapping.measure import ViewFigures, mean_figures, measure_view
from msgs_slam.pipelines.mapping.optimise import OptimisedMap, optimise_map
from msgs_slam.pipelines.mapping.poses import interpolate_rows, move_trajectory
from msgs_slam.pipelines.mapping.submaps import submap_count
from msgs_slam.pipelines.mapping.views import View
from msgs_slam.pipelines.run.folder import RunFolder, save_exposure, save_figures, save_map, save_trajectory
from msgs_slam.pipelines.system.memory import submap_size
from msgs_slam.pipelines.types import Trajectory


def run(context: StageContext) -> dict[str, Any]:
    """The optimised map, made whole or submap by submap; poses and exposures refined with it."""
    context = with_rigid_panoramas(context)
    trajectory = context.run.load_trajectory("tracking")
    kept, _ = split_frames(trajectory, context.config.mapping.hold_out)
    class_ids = _require_views(context, kept)
    size = submap_size(context.config, context.run.load_calibration().intrinsics)
    divided = submap_count(len(kept), size) > 1
    mapped = (map_divided if divided else map_whole)(context, trajectory, class_ids)
    result, ids = mapped.result, mapped.keyframe_ids
    save_map(context.folder, result.gaussian_map)
    save_trajectory(context.folder, mapped.moved)
    save_exposure(context.folder, ids, result.log_gains, result.offsets)
    figures = _figures(mapped)
    submaps = [{"own": s.own.tolist(), "border": s.border.tolist(), "beside": list(s.beside)} for s in mapped.submaps]
    save_figures(context.folder, "mapping", {**figures, "class_ids": list(mapped.class_ids), "submaps": submaps})
    return figures


def map_whole(context: StageContext, trajectory: Trajectory, class_ids: tuple[int, ...]) -> Mapped:
    """Views, depth that agrees between them, one map."""
    settings, seed, paper = context.config.mapping, context.config.run.seed, context.config.paper
    given = load_views(
        context.run, trajectory, settings, context.device, memory=context.memory_room, class_ids=class_ids
    )
    views = given.views
    result = optimise_map(
        views, len(given.class_ids), settings, seed,
        progress=context.progress, snapshot=context.snapshot / "state.safetensors", paper=paper,
    )  # fmt: skip
    ids = np.array([v.frame_id for v in views])
    moved = move_trajectory(trajectory, ids, result.cam_from_world)
    rows = zip(views, result.cam_from_world, result.log_gains, result.offsets, strict=True)
    keyframes = [
        measure_view(result.gaussian_map, *row) for row in context.progress.track(rows, "measuring", len(views))
    ]
    held_out = _measure_held_out(given.held_out, views, result, moved)
    return Mapped(result, ids, given.class_ids, moved, keyframes, held_out)


def _require_views(context: StageContext, kept: Sequence[int]) -> tuple[int, ...]:
    """The label of each class channel; InputError where no keyframe has a depth."""
    run = context.run
    if not kept:
        raise InputError(
            f"{run.root}: no keyframe is left to map (mapping.hold_out = {context.config.mapping.hold_out}). "
            "Hold out fewer frames: --set mapping.hold_out=0"
        )
    class_ids, with_depth = survey(run, kept)
    without = len(kept) - with_depth
    if without == len(kept):
        raise InputError(
            f"{run.root}: none of the {without} keyframes has a depth, so nothing can be mapped. Look at the "
            "warnings of the proxy stage, or give depth with --depth files:FOLDER"
        )
    if without:
        context.warn(f"{without} of {len(kept)} keyframes have no proxy depth: only their colours are used")
    return class_ids


def _figures(mapped: Mapped) -> dict[str, Any]:
    """Key figures over keyframes and held-out frames."""
    return {
        "keyframes": len(mapped.keyframe_ids),
        "gaussians": len(mapped.result.gaussian_map),
        "submaps": max(len(mapped.submaps), 1),
        "iterations": mapped.result.iterations,
        "classes": len(mapped.class_ids),
        **mean_figures(mapped.keyframes, "keyframe"),
        **mean_figures(mapped.held_out, "held_out"),
    }


def _measure_held_out(
    held_out: Sequence[View], views: Sequence[View], result: OptimisedMap, moved: Trajectory
) -> list[ViewFigures]:
    """Frames the map has never seen, at their poses and at the exposure of their neighbours in time."""
    if not held_out:
        return []
    row = {int(i): n for n, i in enumerate(moved.frame_ids)}
    times = np.array([moved.timestamps[row[v.frame_id]] for v in views])
    wanted = np.array([moved.timestamps[row[v.frame_id]] for v in held_out])
    gains = interpolate_rows(wanted, times, result.log_gains)
    offsets = interpolate_rows(wanted, times, result.offsets)
    poses = [moved.cam_from_world[row[v.frame_id]] for v in held_out]
    return [measure_view(result.gaussian_map, *args) for args in zip(held_out, poses, gains, offsets, strict=True)]


def _division(run: RunFolder, config: Config) -> int:
    """Into how many submaps; more for less memory."""
    kept, _ = split_frames(run.load_trajectory("tracking"), config.mapping.hold_out)
    return submap_count(len(kept), submap_size(config, run.load_calibration().intrinsics))


STAGE = Stage("mapping", run, "the semantic Gaussian map from the keyframes", division=_division)
