"""Stage 4: the semantic Gaussian map from the keyframes (MSGS-SLAM 3.4), made and refined submap by submap.

At any time no more than one submap is in work. A recording of the usual length is one submap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...formats.errors import InputError
from ..depth.fields import DepthFields
from ..geometry.posed_depth import PosedDepth, overlaps
from ..render.gaussian_map import GaussianMap
from ..run.files import CALIBRATION, CLASS_IDS, DEPTH_FIELDS, EXPOSURE, FIGURES, MAP, SUBMAPS, TRAJECTORY
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..system.machine import submap_size
from ..types import Trajectory
from .division import split_frames, submap_count
from .measure import ViewFigures, mean_figures
from .move_map import interpolate_rows, move_trajectory, rows_of
from .state import Exposures, OptimisedMap
from .submap_tasks import (
    AGREED,
    JOINED,
    MADE,
    REFINED,
    STEPS,
    SubmapResult,
    SubmapTask,
    measure_submap,
    merge_results,
    select_own,
)
from .submaps import Submap, divide
from .views import survey, with_rigid_panoramas


@dataclass(frozen=True)
class Mapped:
    """A map with what was made beside it: poses and exposures of the keyframes keyframe_ids (N,), label of each
    channel, all frames moved with them, the figures of keyframes and of frames held out, and the submaps."""

    result: OptimisedMap
    keyframe_ids: NDArray[np.int64]
    class_ids: tuple[int, ...]
    moved: Trajectory
    keyframes: Sequence[ViewFigures]
    held_out: Sequence[ViewFigures]
    submaps: Sequence[Submap]


@dataclass(frozen=True)
class Refined:
    """A refined map, its keyframes' poses and exposures, and their mean PSNR before and after."""

    result: OptimisedMap
    psnr_before: float
    psnr_after: float

    @property
    def is_better(self) -> bool:
        """Whether PSNR did not drop; otherwise the refinement is discarded."""
        return self.psnr_after >= self.psnr_before


def build_map(context: StageContext, trajectory: Trajectory, class_ids: tuple[int, ...]) -> Mapped:
    """The map of the keyframes; channel c of its classes is label class_ids[c]."""
    kept, _ = split_frames(trajectory, context.config.mapping.hold_out)
    fields = context.run.load(DEPTH_FIELDS, "tracking")
    submaps = _submaps(context, trajectory, fields, kept)
    tasks = submap_tasks(context, submaps, trajectory, fields, class_ids)
    kind = _each(context, tasks, MADE, JOINED, REFINED, AGREED)
    made = _survey(tasks, kind)
    moved = move_trajectory(trajectory, made.ids, made.cam_from_world)
    keyframes, held_out = measure(context, tasks, moved, made.ids, made.exposure, kind, fields)
    result = all_together(tasks, kind, made)  # last: whole it is the largest thing there is
    return Mapped(result, made.ids, class_ids, moved, keyframes, held_out, submaps)


def refine_map(
    context: StageContext, gaussian_map: GaussianMap, trajectory: Trajectory, fields: DepthFields, passes: float
) -> Refined:
    """A map that is there, and the poses of its keyframes, refined together: every view visited `passes` times."""
    exposure = context.run.load(EXPOSURE)
    ids, exposures = exposure["frame_ids"], (exposure["log_gains"], exposure["offsets"])
    stored = [Submap(s["own"], s["border"], tuple(s["beside"].tolist())) for s in context.run.load(SUBMAPS)]
    submaps, anchors = stored or [Submap.whole(ids)], gaussian_map.anchor_frame_ids.cpu().numpy()
    tasks = submap_tasks(context, submaps, trajectory, fields, context.run.load(CLASS_IDS))
    tasks = [replace(task, passes=passes) for task in tasks]
    for task in tasks:
        rows = np.isin(ids, task.submap.own)
        poses = rows_of(trajectory, task.submap.own).cam_from_world
        own = select_own(gaussian_map, anchors, task.submap) if len(tasks) > 1 else gaussian_map
        nothing = np.zeros((0, 1, 1), np.float32), np.zeros(1, np.int64)
        task.save(JOINED, SubmapResult(own, ids[rows], poses, exposures[0][rows], exposures[1][rows], *nothing))
    kind = _each(context, tasks, REFINED, AGREED)
    before, _ = measure(context, tasks, trajectory, ids, exposures, JOINED, fields)
    made = _survey(tasks, kind)
    moved = move_trajectory(trajectory, made.ids, made.cam_from_world)
    after, _ = measure(context, tasks, moved, made.ids, made.exposure, kind, fields)
    return Refined(all_together(tasks, kind, made), _mean_psnr(before), _mean_psnr(after))


def _each(context: StageContext, tasks: Sequence[SubmapTask], *kinds: str) -> str:
    """Every submap brought from kind to kind of result, all to one before any to the next; the last kind. One submap
    alone has nobody to join and to agree with: the first is the last."""
    kinds = kinds if len(tasks) > 1 else kinds[:1]
    for kind in kinds:
        context.each(STEPS[kind], tasks)
    return kinds[-1]


def _submaps(
    context: StageContext, trajectory: Trajectory, fields: DepthFields, keyframe_ids: Sequence[int]
) -> list[Submap]:
    run, ids = context.run, np.array(keyframe_ids)
    size = submap_size(context.config, run.load(CALIBRATION).intrinsics)
    if submap_count(len(ids), size) == 1:  # what they share need not be known
        return [Submap.whole(ids)]
    return divide(ids, overlaps(_depths(run, trajectory, fields, keyframe_ids)), size)


def _mean_psnr(figures: Sequence[ViewFigures]) -> float:
    return float(np.nanmean([f.psnr for f in figures]))


def submap_tasks(
    context: StageContext,
    submaps: Sequence[Submap],
    trajectory: Trajectory,
    fields: DepthFields,
    class_ids: tuple[int, ...],
) -> list[SubmapTask]:
    """One for each submap, of its own and bordering keyframes."""
    # Parts of another size, as of a run that goes on with other memory, are others.
    files, camera = context.snapshot / f"submaps_{len(submaps)}", context.run.load(CALIBRATION).intrinsics
    return [
        SubmapTask(
            context.run, context.config, files, number, submap, rows_of(trajectory, submap.views),
            _only(fields, submap.views), class_ids, camera,
        )
        for number, submap in enumerate(submaps)
    ]  # fmt: skip


def _depths(
    run: RunFolder, trajectory: Trajectory, fields: DepthFields, frame_ids: Sequence[int]
) -> Iterator[PosedDepth]:
    """The keyframes with their proxy depths, one at a time."""
    camera = run.load(CALIBRATION).intrinsics
    poses = dict(zip(trajectory.frame_ids.tolist(), trajectory.cam_from_world, strict=True))
    for i in frame_ids:
        if (maps := run.find_proxy(i)) is None:
            nothing = np.zeros((camera.height, camera.width), np.float32)
            yield PosedDepth(camera, poses[i], nothing, nothing)
        else:
            height, width = maps.depth.shape
            depth = fields.in_world(i, maps).depth
            yield PosedDepth(camera.resized(width, height), poses[i], depth, maps.confidence)


def _only(fields: DepthFields, frame_ids: NDArray[np.int64]) -> DepthFields:
    wanted = {i: field for i in frame_ids.tolist() if (field := fields.of_frame.get(i)) is not None}
    return DepthFields(wanted) if wanted else fields  # one without any field means another thing


@dataclass(frozen=True)
class _Survey:
    """Of all submaps: ids (N,), poses (N, 4, 4) and exposures of the keyframes in order, how many Gaussians each has,
    and the steps of all."""

    ids: NDArray[np.int64]
    cam_from_world: NDArray[np.float64]
    exposure: Exposures
    counts: list[int]
    steps: int


def _survey(tasks: Sequence[SubmapTask], kind: str) -> _Survey:
    """What there is beside the maps, of which one at a time is in memory."""
    results, counts = [], []
    for task in tasks:
        result = task.load(kind, task.number)
        results.append(result.without_map)
        counts.append(len(result.gaussian_map))
    return _Survey(*merge_results(results), counts, sum(int(r.steps.sum()) for r in results))


def all_together(tasks: Sequence[SubmapTask], kind: str, made: _Survey) -> OptimisedMap:
    """The whole map; held once, with one part of it beside it."""
    whole: dict[str, Tensor] = {}
    for task, end, count in zip(tasks, np.cumsum(made.counts).tolist(), made.counts, strict=True):
        for name, part in vars(task.load(kind, task.number).gaussian_map).items():
            if name not in whole:
                whole[name] = part.new_empty((sum(made.counts), *part.shape[1:]))
            whole[name][end - count : end] = part
    return OptimisedMap(GaussianMap(**whole), made.cam_from_world, *made.exposure, made.steps)


def measure(
    context: StageContext,
    tasks: Sequence[SubmapTask],
    moved: Trajectory,
    ids: NDArray[np.int64],
    exposure: Exposures,
    kind: str,
    fields: DepthFields,
) -> tuple[list[ViewFigures], list[ViewFigures]]:
    """Figures that results of a kind show of the keyframes, in order, and of the frames held out, each measured with
    the submap of the keyframe before it."""
    times = moved.timestamps[np.isin(moved.frame_ids, ids)]
    _, held = split_frames(moved, context.config.mapping.hold_out)
    before = ids[np.clip(np.searchsorted(ids, held) - 1, 0, None)]
    measuring = []
    for task in tasks:
        wanted = np.append(task.submap.own, np.array(held, np.int64)[np.isin(before, task.submap.own)])
        part = rows_of(moved, wanted)
        gains, offsets = (interpolate_rows(part.timestamps, times, a) for a in exposure)
        own, rows = np.isin(part.frame_ids, task.submap.own), np.isin(ids, task.submap.own)
        gains[own], offsets[own] = exposure[0][rows], exposure[1][rows]  # others may be taken at the same time
        known = _only(fields, wanted)
        measuring.append(replace(task, trajectory=part, exposure=(gains, offsets), fields=known, measured=kind))
    found = context.each(measure_submap, measuring)
    ranked = np.argsort(np.concatenate([task.submap.own for task in tasks]))
    keyframes = [figures for own, _ in found for figures in own]
    return [keyframes[r] for r in ranked], [figures for _, others in found for figures in others]


def run(context: StageContext) -> dict[str, Any]:
    """The optimised map; poses and exposures refined with it."""
    context = with_rigid_panoramas(context)
    trajectory = context.run.load(TRAJECTORY, "tracking")
    kept, _ = split_frames(trajectory, context.config.mapping.hold_out)
    class_ids = _require_views(context, kept)
    mapped = build_map(context, trajectory, class_ids)
    result, ids = mapped.result, mapped.keyframe_ids
    context.save(MAP, result.gaussian_map)
    context.save(TRAJECTORY, mapped.moved)
    context.save(EXPOSURE, {"frame_ids": ids, "log_gains": result.log_gains, "offsets": result.offsets})
    figures = _figures(mapped)
    rows = [{"own": s.own.tolist(), "border": s.border.tolist(), "beside": list(s.neighbours)} for s in mapped.submaps]
    submaps = rows if len(rows) > 1 else []  # one alone is all of the map
    context.save(FIGURES["mapping"], {**figures, "class_ids": list(mapped.class_ids), "submaps": submaps})
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
