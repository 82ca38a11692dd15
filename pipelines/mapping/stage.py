"""Stage 4: the semantic Gaussian map from the keyframes (MSGS-SLAM 3.4)."""

from collections.abc import Sequence
from typing import Any

from ...formats.errors import InputError
from ..run.extension import parent_of
from ..run.files import EXPOSURE, FIGURES, MAP, TRAJECTORY
from ..run.stages import StageContext
from .build import Mapped, build_map
from .division import split_frames
from .load import survey, with_rigid_panoramas
from .measure import mean_figures


def run(context: StageContext) -> dict[str, Any]:
    """The optimised map; poses and exposures refined with it."""
    context = with_rigid_panoramas(context)
    trajectory = context.run.load(TRAJECTORY, "tracking")
    kept, _ = split_frames(trajectory, context.config.mapping.hold_out)
    class_ids = _require_views(context, kept)
    mapped = build_map(context, trajectory, class_ids, parent_of(context.source))
    result, ids = mapped.result, mapped.keyframe_ids
    MAP.save(context.folder, result.gaussian_map)
    TRAJECTORY.save(context.folder, mapped.moved)
    EXPOSURE.save(context.folder, {"frame_ids": ids, "log_gains": result.log_gains, "offsets": result.offsets})
    figures = _figures(mapped)
    rows = [{"own": s.own.tolist(), "border": s.border.tolist(), "beside": list(s.beside)} for s in mapped.submaps]
    submaps = rows if len(rows) > 1 else []  # one alone is all of the map
    FIGURES["mapping"].save(context.folder, {**figures, "class_ids": list(mapped.class_ids), "submaps": submaps})
    return figures


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
        "submaps": len(mapped.submaps),
        "iterations": mapped.result.iterations,
        "classes": len(mapped.class_ids),
        **mean_figures(mapped.keyframes, "keyframe"),
        **mean_figures(mapped.held_out, "held_out"),
    }
