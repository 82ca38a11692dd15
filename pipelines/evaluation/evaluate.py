"""A run against the truth: every cell of the table, or why it is empty."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ...formats.datasets import Dataset
from ...formats.errors import InputError
from ..geometry import se3
from ..render.api import Rendering, render
from ..run.outcome import Outcome, spread_sample
from ..sfm.lens import FramePixels
from ..system.progress import Progress, SilentProgress, log
from ..types import Trajectory
from .labels import ClassMap, Counts, Matching, count_labels, label_cells, match_classes
from .metrics import DepthErrorSum, mesh_cells, open_lpips, psnr, ssim
from .truth import (
    AbsoluteError,
    ErrorStatistics,
    MatchedTruth,
    absolute_error,
    has_times,
    match_by_time,
    match_outcome,
    relative_error,
)
from .views import render_outcome

KEYFRAMES, BETWEEN, HELD_OUT = "keyframes", "between", "held out"
AT_TRUE_POSES, AT_REFINED_POSES = " at true poses", " at refined poses"
COVERED, MIN_COVERED = 0.95, 0.2
"""Silhouette of the pixels that a refined pose is found by, and the least share of them in an image."""
SLOPE_PX, NOISE, MAX_STEPS = 0.2, 0.02, 10
"""Pixels by which the image moves to measure its slopes; colour difference, of 1, that counts linearly beyond; steps.
In a room of noise 0.02, from 1 cm and 0.3 degrees: within 0.15 mm of the true pose after 7 steps."""

FREE_UNIT = "units of the truth"
FREE_TRUTH, FREE_RUN = "the truth's poses have no metric scale", "the run has no metric scale"

PROTOCOL = (
    "Frames belong to the truth of the same {by}; the other frames count as picked and posed only.",
    "ATE: distance of camera centres after one alignment (Umeyama) over the frames it is given for: all picked ones, "
    "the keyframes, or every image of the source, those between too; Sim(3) finds the scale, SE(3) does "
    "not.",
    "RPE: motion from one frame with truth to the next, at the scale of Sim(3).",
    "PSNR and SSIM (Gaussian window 11, sigma 1.5) of 8-bit images of the frames' full size, with the exposure that "
    "the run found; mean over views; LPIPS on AlexNet where the extra is installed. Refined poses are those from which "
    "the map looks most like the image; true poses are carried into the run's world by the alignment.",
    "Depth of the map: the surface at which half the light is lost, against the true depth at the same pixel, over "
    "all views with true depth; of a single view in metres, after the one scale unless the run is metric; pixels "
    "without either are left out of L1 and shown as the valid fraction.",
    "Labels: one confusion matrix over all views; pixels without a true class are left out, pixels to which the map "
    "gives no class count as wrong; the mean is over the classes that occur in the truth. Where a class map joins "
    "names that differ, these are the classes that both sides know, and pixels of others are left out.",
    "Mesh: points spread evenly over it, after Sim(3) (SE(3) where depth and truth are metric), where a camera with "
    "true depth sees them; the truth is the points of the true depth.",
)


def evaluate_outcome(
    outcome: Outcome,
    truth: Dataset,
    progress: Progress | None = None,
    max_views: int = 100,
    class_map: ClassMap | None = None,
) -> dict[str, Any]:
    """Compute all figures, as plain JSON values; a group that cannot be had is {"missing": why}.

    At most `max_views` of the keyframes, and as many of the other frames, are rendered. Raises InputError for a truth
    of which no frame belongs to the run, and for a class map that joins nothing here.
    """
    matched = match_outcome(outcome, truth)
    if not matched.has_pose.any() and not (matched.image >= 0).any():
        raise InputError(
            f"{truth.root}: none of its {len(truth)} frames belongs to the {len(outcome.frames)} frames of "
            f"{outcome.run.root} by name or by time. Is it the truth of another recording?"
        )
    if class_map is not None:
        unknown = class_map.unknown((*outcome.classes.names, *outcome.vocabulary), truth.class_names)
        if unknown:
            listed = ", ".join(unknown)
            log.warning("class map %s: there is no class %s. What joins only these is left out", class_map.name, listed)
    matching = match_classes(outcome.classes.names, outcome.vocabulary, truth.class_names, class_map)
    trajectory, alignment = trajectory_cells(outcome, matched)
    usable = outcome.trajectory.frame_ids[outcome.trajectory.is_posed & matched.has_pose]
    errors = [] if alignment is None else [[int(i), float(e)] for i, e in zip(usable, alignment.errors, strict=True)]
    why = {"missing": f"mapping is not done; the last stage is {outcome.pose_stage}"}
    of_map: dict[str, Any] = {"images": why, "depth": why, "labels": why, "views": []}
    if outcome.gaussian_map is not None:
        measured = Measured(outcome, matched, matching)
        jobs = _jobs(outcome, matched, alignment, max_views)
        for job in (progress or SilentProgress()).track(jobs, "measuring", len(jobs)):
            measured.add(*job)
        of_map = measured.cells()
    result = {
        "run": outcome.run.place.name,
        "truth": f"{truth.root.name} ({truth.format})",
        "stage": {"poses": outcome.pose_stage, "map": outcome.map_stage or "none"},
        "unit": "m" if truth.metric else FREE_UNIT,
        "protocol": [line.format(by=matched.by) for line in PROTOCOL],
        "frames": frame_cells(outcome, matched),
        "camera": camera_cells(outcome, truth),
        "trajectory": trajectory,
        "scale": scale_cells(outcome, trajectory, truth),
        "frame errors": errors,
        "keyframe psnr": outcome.keyframe_psnr,
        **of_map,
        "mesh": mesh_cells(outcome, matched, alignment),
        "cost": cost_cells(outcome),
    }
    # A round trip: what cannot be written as JSON (NaN, arrays) shows here and not at the user's.
    return json.loads(json.dumps(result, allow_nan=False))


def frame_cells(outcome: Outcome, matched: MatchedTruth) -> dict[str, Any]:
    """Count the frames of each kind."""
    t, every = outcome.trajectory, outcome.every
    images = {} if every is None else {"images": len(every.frame_ids), "images posed": int(every.is_posed.sum())}
    return images | {
        "picked": len(t.frame_ids),
        "posed": int(t.is_posed.sum()),
        "keyframes": int(t.is_keyframe.sum()),
        "with true pose": int(matched.has_pose.sum()),
        "with true image": int((matched.image >= 0).sum()),
    }


def camera_cells(outcome: Outcome, truth: Dataset) -> dict[str, Any]:
    """The focal length against the true one at the same image size."""
    calibration = outcome.calibration
    k = calibration.intrinsics
    cells: dict[str, Any] = {"origin": calibration.origin, "fx": k.fx, "fy": k.fy, "distortion": calibration.distortion}
    if truth.camera is None:
        return cells | {"missing": "the truth has no camera"}
    true = truth.camera.resized(k.width, k.height)
    return cells | {"true fx": true.fx, "focal error": k.fx / true.fx - 1}


def trajectory_cells(outcome: Outcome, matched: MatchedTruth) -> tuple[dict[str, Any], AbsoluteError | None]:
    """ATE and RPE in the truth's unit, and the alignment over all frames: Sim(3), SE(3) where both are metric."""
    t = outcome.trajectory
    usable = t.is_posed & matched.has_pose
    if usable.sum() < 3:
        why = f"only {int(usable.sum())} posed frames have a true pose, three are needed"
        return {"missing": why}, None
    estimate, truth = t.world_from_cam, matched.world_from_cam
    cells: dict[str, Any] = {}
    for name, with_scale in (("sim3", True), ("se3", False)):
        for frames, rows in (("all", usable), ("keyframes", usable & t.is_keyframe)):
            cells[f"{name} {frames}"] = _ate(estimate[rows, :3, 3], truth[rows, :3, 3], with_scale)
        if outcome.every is not None:
            cells[f"{name} every image"] = _ate_of_every(outcome.every, matched.sequence, with_scale)
    is_metric = outcome.metric and matched.sequence.metric
    if not is_metric:
        for key in [key for key in cells if key.startswith("se3")]:
            cells[key] = {"missing": FREE_TRUTH if outcome.metric else FREE_RUN}
    try:
        sim3 = absolute_error(estimate[usable, :3, 3], truth[usable, :3, 3], with_scale=True)
    except ValueError as error:
        return {"missing": str(error)}, None
    rpe = relative_error(estimate[usable], truth[usable], 1, sim3.alignment.scale)
    cells["rpe"] = {
        "translation rmse": ErrorStatistics.of(rpe.translation).rmse,
        "rotation rmse degrees": ErrorStatistics.of(rpe.rotation).rmse,
        "pairs": len(rpe.rotation),
    }
    best = absolute_error(estimate[usable, :3, 3], truth[usable, :3, 3], False) if is_metric else sim3
    return cells, best


def scale_cells(outcome: Outcome, trajectory: dict[str, Any], truth: Dataset) -> dict[str, Any]:
    """The metres per unit that the run states, with their relative sd, beside the true ones by Sim(3)."""
    if not truth.metric:
        return {"missing": FREE_TRUTH}
    found = trajectory.get("sim3 all", trajectory)
    if "missing" in found:
        return {"missing": found["missing"]}
    true = found["scale"]
    if outcome.metres is None:
        return {"missing": "the run states no scale", "true": true}
    m = outcome.metres
    sigmas = abs(np.log(m.per_unit / true)) / m.relative_sd
    return {"stated": m.per_unit, "relative sd": m.relative_sd, "guess": m.is_guess, "true": true, "sigmas": sigmas}


def _ate(centers: NDArray, true_centers: NDArray, with_scale: bool) -> dict[str, Any]:
    try:
        error = absolute_error(centers, true_centers, with_scale)
    except ValueError as problem:
        return {"missing": str(problem)}
    return {**asdict(error.statistics), "scale": error.alignment.scale, "frames": len(centers)}


def _ate_of_every(every: Trajectory, sequence: Dataset, with_scale: bool) -> dict[str, Any]:
    if not has_times(sequence):
        return {"missing": "the truth has no times"}
    truth = match_by_time(every.timestamps, sequence)
    rows = every.is_posed & truth.has_pose
    return _ate(every.centers[rows], truth.world_from_cam[rows, :3, 3], with_scale)


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


class Measured:
    """Sums over the views of a run: keyframes, held-out frames and frames between at the run's own poses; held-out
    frames also at poses refined on the map, and frames not used for the map at the true ones."""

    def __init__(self, outcome: Outcome, matched: MatchedTruth, matching: Matching | None) -> None:
        self.outcome, self.matched, self.matching = outcome, matched, matching
        self.pixels, self.lpips, self.depth = FramePixels(outcome.calibration), open_lpips(), DepthErrorSum()
        self.views: list[dict[str, Any]] = []
        self.depth_views: list[dict[str, Any]] = []
        true_classes, classes = len(matched.sequence.class_names), len(outcome.classes.names)
        self.confusion: Counts = np.zeros((true_classes, classes + 1), np.int64)

    def add(self, frame_id: int, kind: str, cam_from_world: NDArray[np.float64]) -> None:
        """Measure a frame; nothing of one that is all masked, which shows nothing to compare."""
        outcome, row = self.outcome, self.outcome.frame_row(frame_id)
        frame = outcome.frames[row]
        left_out = outcome.run.left_out(frame)
        if left_out is not None and left_out.all():
            return
        view = render_outcome(outcome, cam_from_world)
        picture, photo = view.exposed(outcome.exposure, frame.timestamp), outcome.run.image(frame)
        if left_out is not None:  # what is no part of the scene is not judged
            photo = np.where(left_out[..., None], picture, photo)
        likeness = psnr(picture, photo, None if left_out is None else ~left_out)
        self.views.append({
            "frame_id": frame_id,
            "kind": kind,
            "psnr": likeness if np.isfinite(likeness) else None,
            "ssim": ssim(picture, photo),
            "lpips": None if isinstance(self.lpips, str) else self.lpips(picture, photo),
            "label_accuracy": None,
            "depth_l1": None,
        })  # fmt: skip
        # From another pose than the run's the image alone is compared: depth and labels count once a frame.
        if (index := int(self.matched.image[row])) < 0 or kind.endswith((AT_TRUE_POSES, AT_REFINED_POSES)):
            return
        if (depth := self.matched.sequence.depth(index)) is not None:
            self.depth.add(view.depth, self.pixels.sample(depth))
            self.depth_views.append(self.views[-1])
        if (labels := self.matched.sequence.labels(index)) is not None:
            self.views[-1]["label_accuracy"] = self._add_labels(view.labels, self.pixels.sample(labels))

    def _add_labels(self, labels: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float | None:
        """Share of the pixels with a true class that have it; None where the classes' names differ."""
        counts = count_labels(labels, truth, self.confusion.shape[1] - 1, len(self.confusion))
        self.confusion += counts
        joined = None if self.matching is None else self.matching.joined(counts)
        if joined is None or joined.sum() == 0:
            return None
        return float(np.trace(joined[:, :-1]) / joined.sum())

    def images(self) -> dict[str, Any]:
        """Mean PSNR, SSIM and LPIPS by kind of view."""
        cells: dict[str, Any] = {}
        missing = {"missing": self.lpips} if isinstance(self.lpips, str) else None
        for kind in dict.fromkeys(v["kind"] for v in self.views):
            chosen = [v for v in self.views if v["kind"] == kind]
            finite = [v["psnr"] for v in chosen if v["psnr"] is not None]
            cells[kind] = {
                "psnr": float(np.mean(finite)) if finite else None,
                "ssim": float(np.mean([v["ssim"] for v in chosen])),
                "lpips": missing or float(np.mean([v["lpips"] for v in chosen])),
                "views": len(chosen),
            }
        if HELD_OUT not in cells:
            cells[HELD_OUT] = {"missing": "no frame was held out; reconstruct with --hold-out 8"}
        return cells

    def cells(self) -> dict[str, Any]:
        """Collect the groups images, depth, labels and views of the result."""
        depth, is_metric = self.depth.result(), self.outcome.metric
        depth_cells: dict[str, Any] = {"missing": "no rendered view has a true depth"}
        if depth is not None:
            depth_cells = asdict(depth) | ({} if is_metric else {"metric_l1": {"missing": FREE_RUN}})
            of_views = self.depth.l1(1.0 if is_metric else depth.scale)
            for view, l1 in zip(self.depth_views, of_views, strict=True):
                view["depth_l1"] = l1
        names = self.matched.sequence.class_names
        return {
            "images": self.images(),
            "depth": depth_cells,
            "labels": label_cells(self.confusion, self.matching, self.outcome.semantics, names),
            "views": self.views,
        }


def _jobs(
    outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None, max_views: int
) -> list[tuple[int, str, NDArray[np.float64]]]:
    t = outcome.trajectory
    keyframes, held_out = t.split(outcome.config.mapping.hold_out)
    used = {*keyframes, *held_out, *t.frame_ids[t.is_keyframe].tolist()}
    between = [i for i in t.frame_ids[t.is_posed].tolist() if i not in used]
    poses = dict(zip(t.frame_ids.tolist(), t.cam_from_world, strict=True))
    jobs = []
    for kind, ids in ((KEYFRAMES, keyframes), (HELD_OUT, held_out), (BETWEEN, between)):
        jobs += [(i, kind, poses[i]) for i in spread_sample(ids, max_views)]
    jobs += [
        (i, HELD_OUT + AT_REFINED_POSES, refined_pose(outcome, i, poses[i])) for i in spread_sample(held_out, max_views)
    ]
    if alignment is None:
        return jobs
    # The true cameras, carried into the run's world.
    true_ids = [i for i in (held_out or between) if matched.has_pose[outcome.frame_row(i)]]
    chosen = spread_sample(true_ids, max_views)
    rows = [outcome.frame_row(i) for i in chosen]
    true_poses = alignment.alignment.inverse().apply_to_poses(np.linalg.inv(matched.world_from_cam[rows]))
    kind = (HELD_OUT if held_out else BETWEEN) + AT_TRUE_POSES
    return jobs + [(i, kind, pose) for i, pose in zip(chosen, true_poses, strict=True)]


def refined_pose(outcome: Outcome, frame_id: int, cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the pose (4, 4) near a given one from which the map looks most like the frame's image, without any truth.

    It minimises the differences of colour over the pixels that the map covers, by least squares that are robust. Where
    the map covers too little of the image, the pose given is returned. Raises InputError for a run without a map.
    """
    m, camera = outcome.require_map(), outcome.calibration.intrinsics
    frame = outcome.frames[outcome.frame_row(frame_id)]
    photo = (outcome.run.image(frame) / np.float32(255)).astype(np.float32)
    if outcome.exposure is not None:
        photo = outcome.exposure.remove(photo, frame.timestamp)
    image = torch.as_tensor(photo, device=m.means.device)

    @torch.no_grad()
    def seen(pose: NDArray[np.float64]) -> Rendering:
        return render(m.means, m.radii, m.opacities, m.colors, torch.from_numpy(pose), camera)

    start = seen(cam_from_world)
    covered = start.silhouette >= COVERED
    if covered.float().mean() < MIN_COVERED:
        return cam_from_world
    # Steps are counted in pixels that the image moves by, of a translation as of a rotation.
    pixel = np.repeat([float(start.depth[covered].median()), 1.0], 3) / max(camera.fx, camera.fy)

    def differences(step: NDArray[np.float64]) -> NDArray[np.float64]:
        shown = seen(se3.exp(step * pixel) @ cam_from_world).features
        return (shown - image)[covered].double().cpu().numpy().ravel()

    def slopes(step: NDArray[np.float64]) -> NDArray[np.float64]:
        here = differences(step)
        return np.stack([(differences(step + by) - here) / SLOPE_PX for by in SLOPE_PX * np.eye(6)], 1)

    fit = least_squares(
        differences, np.zeros(6), slopes, loss="soft_l1", f_scale=NOISE, xtol=1e-3, ftol=1e-4, max_nfev=MAX_STEPS
    )
    found: NDArray[np.float64] = se3.exp(fit.x * pixel) @ cam_from_world
    return found
