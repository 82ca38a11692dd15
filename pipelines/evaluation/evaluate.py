"""A run against the truth: every cell of the table, or why it is empty."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Sequence
from ...formats.errors import InputError
from ..outcome import Outcome
from ..system.progress import Progress, SilentProgress
from .class_map import ClassMap, Matching, match_classes
from .measure import measure_views
from .mesh_cells import mesh_cells
from .trajectory_error import (
    AbsoluteError,
    ErrorStatistics,
    absolute_error,
    relative_error,
)
from .truth import MatchedTruth, match_truth

PROTOCOL = (
    "Frames belong to the truth of the same {by}; the other frames count as picked and posed only.",
    "ATE: distance of camera centres after one alignment (Umeyama) over the frames it is given for; Sim(3) finds the "
    "scale, SE(3) does not.",
    "RPE: motion from one frame with truth to the next, at the scale of Sim(3).",
    "PSNR and SSIM (Gaussian window 11, sigma 1.5) of 8-bit images of the frames' full size, with the exposure that "
    "the run found; mean over views; LPIPS on AlexNet where the extra is installed. Refined poses are those from which "
    "the map looks most like the image; true poses are carried into the run's world by the alignment.",
    "Depth of the map: the surface at which half the light is lost, against the true depth at the same pixel, over "
    "all views with true depth; pixels without either are left out of L1 and shown as the valid fraction.",
    "Labels: one confusion matrix over all views; pixels without a true class are left out, pixels to which the map "
    "gives no class count as wrong; the mean is over the classes that occur in the truth. Where a class map joins "
    "names that differ, these are the classes that both sides know, and pixels of others are left out.",
    "Mesh: points spread evenly over it, after Sim(3) (SE(3) where the depth is metric), where a camera with true "
    "depth sees them; the truth is the points of the true depth.",
)


def evaluate_outcome(
    outcome: Outcome,
    truth: Sequence,
    progress: Progress | None = None,
    max_views: int = 100,
    class_map: ClassMap | None = None,
) -> dict[str, Any]:
    """Compute all figures, as plain JSON values; a group that cannot be had is {"missing": why}.

    At most `max_views` of the keyframes, and as many of the other frames, are rendered. Raises InputError for a truth
    of which no frame belongs to the run, and for a class map that does not fit.
    """
    matched = match_truth(outcome.frames, outcome.source_is_folder, truth)
    if not matched.has_pose.any() and not (matched.image >= 0).any():
        raise InputError(
            f"{truth.root}: none of its {len(truth)} frames belongs to the {len(outcome.frames)} frames of "
            f"{outcome.run.root} by name or by time. Is it the truth of another recording?"
        )
    matching = _matching(outcome, truth, class_map)
    trajectory, alignment = trajectory_cells(outcome, matched)
    measured = None
    if outcome.gaussian_map is not None:
        measured = measure_views(outcome, matched, alignment, matching, progress or SilentProgress(), max_views)
    result = {
        "run": outcome.run.root.name,
        "truth": f"{truth.root.name} ({truth.format})",
        "stage": {"poses": outcome.pose_stage, "map": outcome.map_stage or "none"},
        "protocol": [line.format(by=matched.by) for line in PROTOCOL],
        "frames": frame_cells(outcome, matched),
        "camera": camera_cells(outcome, truth),
        "trajectory": trajectory,
        "scale": scale_cells(outcome, trajectory),
        "frame errors": frame_errors(outcome, matched, alignment),
        **(measured.cells(outcome, matched) if measured else _without_map(outcome)),
        "mesh": mesh_cells(outcome, matched, alignment),
        "cost": cost_cells(outcome),
    }
    # A round trip: what cannot be written as JSON (NaN, arrays) shows here and not at the user's.
    return json.loads(json.dumps(result, allow_nan=False))


def _matching(outcome: Outcome, truth: Sequence, class_map: ClassMap | None) -> Matching | None:
    if class_map is not None:
        class_map.require_known((*outcome.classes.names, *outcome.vocabulary), truth.class_names)
    return match_classes(outcome.classes.names, outcome.vocabulary, truth.class_names, class_map)


def _without_map(outcome: Outcome) -> dict[str, Any]:
    why = {"missing": f"mapping is not done; the last stage is {outcome.pose_stage}"}
    return {"images": why, "depth": why, "labels": why, "views": []}


def frame_cells(outcome: Outcome, matched: MatchedTruth) -> dict[str, Any]:
    """Count the frames of each kind."""
    t = outcome.trajectory
    return {
        "picked": len(t.frame_ids),
        "posed": int(t.is_posed.sum()),
        "by rotation alone": int(t.by_rotation.sum()),
        "keyframes": int(t.is_keyframe.sum()),
        "with true pose": int(matched.has_pose.sum()),
        "with true image": int((matched.image >= 0).sum()),
    }


def camera_cells(outcome: Outcome, truth: Sequence) -> dict[str, Any]:
    """The focal length against the true one at the same image size."""
    calibration = outcome.calibration
    k = calibration.intrinsics
    cells: dict[str, Any] = {"origin": calibration.origin, "fx": k.fx, "fy": k.fy, "distortion": calibration.distortion}
    if truth.camera is None:
        return cells | {"missing": "the truth has no camera"}
    true = truth.camera.resized(k.width, k.height)
    return cells | {"true fx": true.fx, "focal error": k.fx / true.fx - 1}


def trajectory_cells(outcome: Outcome, matched: MatchedTruth) -> tuple[dict[str, Any], AbsoluteError | None]:
    """ATE and RPE, and the Sim(3) alignment over all frames (SE(3) where the depth is metric)."""
    t = outcome.trajectory
    usable = t.is_placed & matched.has_pose
    if usable.sum() < 3:
        why = f"only {int(usable.sum())} posed frames have a true pose, three are needed"
        return {"missing": why}, None
    estimate, truth = t.world_from_cam, matched.world_from_cam
    cells: dict[str, Any] = {}
    for name, with_scale in (("sim3", True), ("se3", False)):
        for frames, rows in (("all", usable), ("keyframes", usable & t.is_keyframe)):
            cells[f"{name} {frames}"] = _ate(estimate[rows, :3, 3], truth[rows, :3, 3], with_scale)
    if not outcome.metric:
        for frames in ("all", "keyframes"):
            cells[f"se3 {frames}"] = {"missing": "the run has no metric scale"}
    try:
        sim3 = absolute_error(estimate[usable, :3, 3], truth[usable, :3, 3], with_scale=True)
    except ValueError as error:
        return {"missing": str(error)}, None
    cells["rpe"] = _rpe(estimate[usable], truth[usable], sim3.alignment.scale)
    best = absolute_error(estimate[usable, :3, 3], truth[usable, :3, 3], False) if outcome.metric else sim3
    return cells, best


def scale_cells(outcome: Outcome, trajectory: dict[str, Any]) -> dict[str, Any]:
    """The metres per unit that the run states, with their relative sd, beside the true ones by Sim(3)."""
    found = trajectory.get("sim3 all", trajectory)
    if "missing" in found:
        return {"missing": found["missing"]}
    true = found["scale"]
    if outcome.metres is None:
        return {"missing": "the run states no scale", "true": true}
    m = outcome.metres
    sigmas = abs(np.log(m.per_unit / true)) / m.relative_sd
    return {"stated": m.per_unit, "relative sd": m.relative_sd, "guess": m.is_guess, "true": true, "sigmas": sigmas}


def frame_errors(outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None) -> list[list[float]]:
    """[frame id, metres] of every frame that the alignment was made from."""
    if alignment is None:
        return []
    ids = outcome.trajectory.frame_ids[outcome.trajectory.is_placed & matched.has_pose]
    return [[int(i), float(e)] for i, e in zip(ids, alignment.errors, strict=True)]


def _ate(centers: NDArray, true_centers: NDArray, with_scale: bool) -> dict[str, Any]:
    try:
        error = absolute_error(centers, true_centers, with_scale)
    except ValueError as problem:
        return {"missing": str(problem)}
    return {**asdict(error.statistics), "scale": error.alignment.scale, "frames": len(centers)}


def _rpe(estimate: NDArray, truth: NDArray, scale: float) -> dict[str, Any]:
    error = relative_error(estimate, truth, 1, scale)
    translation, rotation = ErrorStatistics.of(error.translation), ErrorStatistics.of(error.rotation)
    return {"translation rmse": translation.rmse, "rotation rmse degrees": rotation.rmse, "pairs": len(error.rotation)}


def cost_cells(outcome: Outcome) -> dict[str, Any]:
    """Seconds of each stage, frames a second over all of them, peak memory, size of the map."""
    seconds = {name: record.seconds for name, record in outcome.records.items()}
    total = sum(seconds.values())
    m = outcome.gaussian_map
    return {
        "seconds": seconds,
        "total seconds": total,
        "frames per second": len(outcome.frames) / total if total > 0 else 0.0,
        "peak memory MB": max((r.peak_memory_mb for r in outcome.records.values()), default=0.0),
        "gaussians": 0 if m is None else len(m),
        "map MB": 0.0 if m is None else sum(v.numel() * v.element_size() for v in vars(m).values()) / 1e6,
    }
