"""Stage 4: the semantic Gaussian map from the keyframes (MSGS-SLAM 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from formats.errors import InputError
from pipelines.mapping.load import MappingInput, load_views
from pipelines.mapping.measure import ViewFigures, mean_figures, measure_view
from pipelines.mapping.optimise import OptimisedMap, optimise_map
from pipelines.mapping.poses import interpolate_rows, move_trajectory
from pipelines.mapping.views import View
from pipelines.run_folder import save_exposure, save_figures, save_map, save_trajectory
from pipelines.stages import Stage, StageContext
from pipelines.types import Trajectory


def run(context: StageContext) -> dict[str, Any]:
    """Views, depth that agrees between them, the optimised map; poses and exposures refined with it."""
    settings, seed = context.config.mapping, context.config.run.seed
    trajectory = context.run.load_trajectory("tracking")
    article, memory = context.config.article, context.memory_room
    given = load_views(context.run, trajectory, settings, article, context.device, memory=memory)
    _require_views(given, context)

    views = given.views
    result = optimise_map(
        views, len(given.class_ids), settings, seed,
        progress=context.progress, snapshot=context.snapshot / "state.safetensors", article=context.config.article,
    )  # fmt: skip

    keyframe_ids = np.array([v.frame_id for v in views])
    moved = move_trajectory(trajectory, keyframe_ids, result.cam_from_world)
    save_map(context.folder, result.gaussian_map)
    save_trajectory(context.folder, moved)
    save_exposure(context.folder, keyframe_ids, result.log_gains, result.offsets)
    figures = _figures(context, given, result, moved)
    save_figures(context.folder, "mapping", {**figures, "class_ids": list(given.class_ids)})
    return figures


def _require_views(given: MappingInput, context: StageContext) -> None:
    if not given.views:
        raise InputError(
            f"{context.run.root}: no keyframe is left to map (mapping.hold_out = {context.config.mapping.hold_out}). "
            "Hold out fewer frames: --set mapping.hold_out=0"
        )
    without = sum(not bool((v.depth > 0).any()) for v in given.views)
    if without == len(given.views):
        raise InputError(
            f"{context.run.root}: none of the {without} keyframes has a depth, so nothing can be mapped. Look at the "
            "warnings of the proxy stage, or give depth with --depth files:FOLDER"
        )
    if without:
        context.warn(f"{without} of {len(given.views)} keyframes have no proxy depth; they count by their colours only")


def _figures(context: StageContext, given: MappingInput, result: OptimisedMap, moved: Trajectory) -> dict[str, Any]:
    """Key figures over keyframes and held-out frames."""
    views = given.views
    rows = zip(views, result.cam_from_world, result.log_gains, result.offsets, strict=True)
    keyframes = [
        measure_view(result.gaussian_map, *row) for row in context.progress.track(rows, "measuring", len(views))
    ]
    return {
        "keyframes": len(views),
        "gaussians": len(result.gaussian_map),
        "iterations": result.iterations,
        "classes": len(given.class_ids),
        **mean_figures(keyframes, "keyframe"),
        **mean_figures(_measure_held_out(given.held_out, views, result, moved), "held_out"),
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


STAGE = Stage("mapping", run, "the semantic Gaussian map from the keyframes")
