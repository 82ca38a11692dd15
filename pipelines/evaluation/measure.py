"""Rendering the map at a run's views and collecting what the comparison with images and truth gives."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..mapping.load import split_frames
from ..outcome import Outcome, evenly
from ..render.tracking import track_gn
from ..source.source_pixels import FramePixels
from ..system.progress import Progress
from .class_map import Matching
from .depth_error import DepthErrorSum
from .image_quality import psnr, ssim
from .label_cells import label_cells
from .label_score import Counts, count_labels
from .perceptual import open_lpips
from .trajectory_error import AbsoluteError
from .truth import MatchedTruth
from .views import MapView, view_map

KEYFRAMES, BETWEEN, HELD_OUT = "keyframes", "between", "held out"
AT_TRUE_POSES, AT_REFINED_POSES = " at true poses", " at refined poses"


@dataclass(frozen=True)
class MeasuredView:
    """One rendered frame; lpips NaN where it cannot be had; depth_l1 in the run's unit, NaN without truth.
    label_accuracy: share of the pixels with a true class that have it; NaN where the classes' names differ."""

    frame_id: int
    kind: str
    psnr: float
    ssim: float
    lpips: float
    depth_l1: float
    label_accuracy: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name, with None for NaN."""
        return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(self).items()}


class Measured:
    """Sums over the views of a run."""

    def __init__(self, names: tuple[str, ...], true_names: tuple[str, ...], matching: Matching | None) -> None:
        self.views: list[MeasuredView] = []
        self.lpips = open_lpips()
        self.depth = DepthErrorSum()
        self.matching = matching
        self.confusion: Counts = np.zeros((len(true_names), len(names) + 1), np.int64)

    def images(self) -> dict[str, Any]:
        """Mean PSNR, SSIM and LPIPS by kind of view."""
        cells: dict[str, Any] = {}
        for kind in dict.fromkeys(v.kind for v in self.views):
            chosen = [v for v in self.views if v.kind == kind]
            finite = [v.psnr for v in chosen if np.isfinite(v.psnr)]
            cells[kind] = {
                "psnr": float(np.mean(finite)) if finite else None,
                "ssim": float(np.mean([v.ssim for v in chosen])),
                "lpips": {"missing": self.lpips}
                if isinstance(self.lpips, str)
                else float(np.mean([v.lpips for v in chosen])),
                "views": len(chosen),
            }
        if HELD_OUT not in cells:
            cells[HELD_OUT] = {"missing": "no frame was held out; reconstruct with --hold-out 8"}
        return cells

    def cells(self, outcome: Outcome, matched: MatchedTruth) -> dict[str, Any]:
        """The groups images, depth, labels and views of the result."""
        depth = self.depth.result()
        depth_cells: dict[str, Any] = {"missing": "no rendered view has a true depth"}
        if depth is not None:
            depth_cells = asdict(depth)
            if not outcome.metric:
                depth_cells["metric_l1"] = {"missing": "the run has no metric scale"}
        return {
            "images": self.images(),
            "depth": depth_cells,
            "labels": label_cells(self.confusion, self.matching, outcome.semantics, matched.sequence.class_names),
            "views": [v.to_json() for v in self.views],
        }


def measure_views(
    outcome: Outcome,
    matched: MatchedTruth,
    alignment: AbsoluteError | None,
    matching: Matching | None,
    progress: Progress,
    max_views: int,
) -> Measured:
    """Keyframes, held-out frames and frames between at the run's own poses; held-out frames also at poses refined on
    the map, and frames not used for the map at the true ones."""
    measured = Measured(outcome.classes.names, matched.sequence.class_names, matching)
    pixels = FramePixels(outcome.calibration)
    jobs = _jobs(outcome, matched, alignment, max_views)
    for frame_id, kind, cam_from_world in progress.track(jobs, "measuring", len(jobs)):
        view = render_outcome(outcome, cam_from_world)
        measured.views.append(_measure(outcome, matched, pixels, measured, view, frame_id, kind))
    return measured


def render_outcome(outcome: Outcome, cam_from_world: NDArray[np.float64]) -> MapView:
    """The run's map at the size of its frames. Raises InputError for a run without a map."""
    return view_map(outcome.require_map(), outcome.label_of_channel, outcome.calibration.intrinsics, cam_from_world)


def _jobs(
    outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None, max_views: int
) -> list[tuple[int, str, NDArray[np.float64]]]:
    t = outcome.trajectory
    keyframes, held_out = split_frames(t, outcome.config.mapping.hold_out)
    used = {*keyframes, *held_out, *t.frame_ids[t.is_keyframe].tolist()}
    between = [i for i in t.frame_ids[t.is_placed].tolist() if i not in used]
    poses = dict(zip(t.frame_ids.tolist(), t.cam_from_world, strict=True))
    jobs = []
    for kind, ids in ((KEYFRAMES, keyframes), (HELD_OUT, held_out), (BETWEEN, between)):
        jobs += [(i, kind, poses[i]) for i in evenly(ids, max_views)]
    jobs += [(i, HELD_OUT + AT_REFINED_POSES, refined_pose(outcome, i, poses[i])) for i in evenly(held_out, max_views)]
    if alignment is None:
        return jobs
    # The true cameras, carried into the run's world.
    true_ids = [i for i in (held_out or between) if matched.has_pose[outcome.frame_row(i)]]
    chosen = evenly(true_ids, max_views)
    rows = [outcome.frame_row(i) for i in chosen]
    true_poses = alignment.alignment.inverse().apply_to_poses(np.linalg.inv(matched.world_from_cam[rows]))
    kind = (HELD_OUT if held_out else BETWEEN) + AT_TRUE_POSES
    return jobs + [(i, kind, pose) for i, pose in zip(chosen, true_poses, strict=True)]


def refined_pose(outcome: Outcome, frame_id: int, cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) the pose from which the map looks most like the frame's image, found without any truth.

    The pose as it was where the fit does not converge. Raises InputError for a run without a map.
    """
    m = outcome.require_map()
    frame = outcome.frames[outcome.frame_row(frame_id)]
    photo = (outcome.run.image(frame) / np.float32(255)).astype(np.float32)
    if outcome.exposure is not None:
        photo = outcome.exposure.remove(photo, frame.timestamp)
    fit = track_gn(
        m.means, m.radii, m.opacities, m.colors, torch.as_tensor(cam_from_world, device=m.means.device),
        outcome.calibration.intrinsics, torch.as_tensor(photo, device=m.means.device),
    )  # fmt: skip
    return fit.cam_from_world.cpu().numpy() if fit.converged else cam_from_world


def _measure(
    outcome: Outcome,
    matched: MatchedTruth,
    pixels: FramePixels,
    measured: Measured,
    view: MapView,
    frame_id: int,
    kind: str,
) -> MeasuredView:
    row = outcome.frame_row(frame_id)
    frame = outcome.frames[row]
    picture, photo = view.exposed(outcome.exposure, frame.timestamp), outcome.run.image(frame)
    left_out = outcome.run.left_out(frame)
    if left_out is not None:  # what is no part of the scene is not judged
        photo = np.where(left_out[..., None], picture, photo)
    depth_l1 = accuracy = float("nan")
    # At other poses only the image is compared: depth and labels count once a frame.
    if matched.image[row] >= 0 and not kind.endswith((AT_TRUE_POSES, AT_REFINED_POSES)):
        index = int(matched.image[row])
        if (depth := matched.sequence.depth(index)) is not None:
            depth_l1 = _add_depth(measured, view, pixels.sample(depth))
        if (labels := matched.sequence.labels(index)) is not None:
            accuracy = _add_labels(measured, view, pixels.sample(labels))
    perceived = float("nan") if isinstance(measured.lpips, str) else measured.lpips(picture, photo)
    judged = left_out is None or not left_out.all()
    likeness = psnr(picture, photo, None if left_out is None else ~left_out) if judged else float("nan")
    return MeasuredView(frame_id, kind, likeness, ssim(picture, photo), perceived, depth_l1, accuracy)


def _add_depth(measured: Measured, view: MapView, truth: NDArray[np.float32]) -> float:
    measured.depth.add(view.depth, truth)
    both = (truth > 0) & (view.depth > 0)
    return float(np.abs(view.depth - truth)[both].mean()) if both.any() else float("nan")


def _add_labels(measured: Measured, view: MapView, truth: NDArray[np.uint8]) -> float:
    true_classes, classes = len(measured.confusion), measured.confusion.shape[1] - 1
    counts = count_labels(view.labels, truth, classes, true_classes)
    measured.confusion += counts
    joined = None if measured.matching is None else measured.matching.joined(counts)
    if joined is None or joined.sum() == 0:
        return float("nan")
    return float(np.trace(joined[:, :-1]) / joined.sum())
