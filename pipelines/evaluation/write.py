"""The evaluation on disk: figures, table, pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...formats.atomic import write_text
from ...formats.datasets import Sequence
from ...formats.images import write_rgb
from ...formats.jsonfile import write_json
from ..geometry.se3 import Similarity, align_points
from ..outcome import Outcome, evenly, load_outcome
from ..run.folder import RunFolder
from ..source.source_pixels import FramePixels
from ..system.progress import Progress
from .class_map import ClassMap
from .evaluate import evaluate_outcome
from .measure import render_outcome
from .pictures import (
    Picture,
    class_colors_by_name,
    depth_picture,
    depth_range,
    error_picture,
    label_picture,
    sheet,
)
from .plots import BLUE, GREY, Line, plot
from .table import evaluation_table
from .truth import MatchedTruth, match_truth

PATH_FROM_ABOVE, PATH_FROM_THE_SIDE = "trajectory_top.svg", "trajectory_side.svg"
SHEET_VIEWS = 6
TITLES = ("frame", "map", "depth of the map", "true depth", "error, white = 10 %", "labels of the map", "true labels")


def write_evaluation(
    run: RunFolder,
    truth: Sequence,
    progress: Progress | None = None,
    max_views: int = 100,
    class_map: ClassMap | None = None,
) -> dict[str, Any]:
    """Evaluate and write RUN/evaluation/: evaluation.json, evaluation.md, two plots of the path, views.png.

    Returns the figures (see `evaluate_outcome`). Raises InputError as that does, and for a run without poses, before
    anything is written.
    """
    outcome = load_outcome(run)
    result = evaluate_outcome(outcome, truth, progress, max_views, class_map)
    folder = run.evaluation_file.parent
    write_json(run.evaluation_file, result)
    write_text(folder / "evaluation.md", evaluation_table(result))
    matched = match_truth(outcome.frames, outcome.source_is_folder, truth)
    top, side = trajectory_plots(outcome, matched)
    write_text(folder / PATH_FROM_ABOVE, top)
    write_text(folder / PATH_FROM_THE_SIDE, side)
    if outcome.gaussian_map is not None:
        write_rgb(folder / "views.png", comparison_sheet(outcome, matched))
    return result


def trajectory_plots(outcome: Outcome, matched: MatchedTruth | None, upright: bool = False) -> tuple[str, str]:
    """SVGs of the camera path from above and from the side, with the truth where there is one.

    The axes are the path's own: its plane of largest extent is looked at from above; those of the world, where it
    is `upright`.
    """
    t = outcome.trajectory
    centers = np.where(t.is_posed[:, None], t.centers, np.nan)
    truth, unit = np.full_like(centers, np.nan), unit_name(outcome)
    if matched is not None and (both := t.is_posed & matched.has_pose).sum() >= 3:
        found = _aligned(centers[both], matched.world_from_cam[both, :3, 3], not outcome.metric)
        if found is not None:
            centers, truth, unit = found.apply(centers), matched.world_from_cam[:, :3, 3], "m"
    axes = np.eye(3) if upright else _main_axes(centers[np.isfinite(centers).all(axis=1)])
    plots = []
    for name, x, y in (("Camera path from above", 0, 1), ("Camera path from the side", 0, 2)):
        lines = [Line(_projected(centers, axes, x, y), BLUE, "this run")]
        if np.isfinite(truth).any():
            # Rows without truth would tear the line: it is drawn over those that have one.
            known = truth[np.isfinite(truth).all(axis=1)]
            lines.insert(0, Line(_projected(known, axes, x, y), GREY, "truth", dashed=True))
        plots.append(plot(name, unit, unit, lines, equal=True))
    return plots[0], plots[1]


def unit_name(outcome: Outcome) -> str:
    """Name the unit of length, with the estimated length in metres where the world is not metric."""
    if outcome.metric:
        return "m"
    return "units" if outcome.metres is None else f"units (1 ≈ {outcome.metres.per_unit:.2g} m)"


def _aligned(centers: np.ndarray, truth: np.ndarray, with_scale: bool) -> Similarity | None:
    try:
        return align_points(centers, truth, with_scale)
    except ValueError:  # a path along one line has no alignment; it is drawn as it is
        return None


def _main_axes(points: np.ndarray) -> np.ndarray:
    """(3, 3) rows: directions of largest to smallest extent."""
    if len(points) < 3:
        return np.eye(3)
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2]
    # A fixed sign, so that the picture does not flip between two runs.
    return axes * np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1, 1)[:, None]


def _projected(points: np.ndarray, axes: np.ndarray, x: int, y: int) -> np.ndarray:
    return points @ axes[[x, y]].T


def comparison_sheet(outcome: Outcome, matched: MatchedTruth, views: int = SHEET_VIEWS) -> Picture:
    """Rows of frame, rendering, depths and labels; of frames with truth where there are some."""
    posed = np.flatnonzero(outcome.trajectory.is_posed)
    with_truth = [int(r) for r in posed if matched.image[r] >= 0]
    rows = evenly(with_truth or posed.tolist(), views)
    pixels = FramePixels(outcome.calibration)
    return sheet([_row(outcome, matched, pixels, row) for row in rows], TITLES)


def _row(outcome: Outcome, matched: MatchedTruth, pixels: FramePixels, row: int) -> list[Picture]:
    view = render_outcome(outcome, outcome.trajectory.cam_from_world[row])
    frame, colors = outcome.frames[row], outcome.classes.colors
    index = int(matched.image[row])
    truth = matched.sequence.depth(index) if index >= 0 else None
    depth = np.zeros_like(view.depth) if truth is None else pixels.sample(truth)
    both = (depth > 0) & (view.depth > 0)
    scale = float(np.median(depth[both] / view.depth[both])) if both.any() and not outcome.metric else 1.0
    shown = view.depth * np.float32(scale)
    near, far = depth_range(depth if truth is not None else shown)
    error = np.where(both, np.abs(shown - depth) / np.maximum(depth, 1e-6), 0)
    labels = matched.sequence.labels(index) if index >= 0 else None
    true_colors = class_colors_by_name(
        matched.sequence.class_names, [c.color for c in matched.sequence.classes], outcome.classes
    )
    nothing = np.full((*view.depth.shape, 3), 40, np.uint8)
    return [
        outcome.run.image(frame),
        view.exposed(outcome.exposure, frame.timestamp),
        depth_picture(shown, near, far),
        depth_picture(depth, near, far),
        error_picture(error, both, 0.1),
        label_picture(view.labels, colors),
        nothing if labels is None else label_picture(pixels.sample(labels), true_colors),
    ]
