"""The evaluation on disk: figures, their table in Markdown, images."""

from typing import Any

import numpy as np

from ...formats.atomic import write_text
from ...formats.datasets import Dataset
from ...formats.images import write_rgb
from ...formats.textfile import write_json
from ..geometry.se3 import Similarity, align_points
from ..outcome import Outcome, load_outcome, spread_sample
from ..run.files import MESH
from ..run.folder import RunFolder
from ..sfm.lens import FramePixels
from ..system.progress import Progress
from ..system.wording import markdown_table
from .evaluate import FREE_UNIT, evaluate_outcome
from .html import BLUE, GREY, Line, plot
from .labels import ClassMap
from .truth import MatchedTruth, match_outcome
from .views import (
    Picture,
    class_colors_by_name,
    depth_picture,
    depth_range,
    error_picture,
    label_picture,
    render_outcome,
    sheet,
)

Row = tuple[str, str, str]
TABLE_HEADER: Row = ("what", "value", "of")

JUDGED = "judged"
"""Key of evaluation.json: the `identity_of` the outcome."""
PATH_FROM_ABOVE, PATH_FROM_THE_SIDE = "trajectory_top.svg", "trajectory_side.svg"
SHEET_VIEWS = 6
TITLES = ("frame", "map", "depth of the map", "true depth", "error, white = 10 %", "labels of the map", "true labels")


def write_evaluation(
    run: RunFolder,
    truth: Dataset,
    progress: Progress | None = None,
    max_views: int = 100,
    class_map: ClassMap | None = None,
) -> dict[str, Any]:
    """Evaluate and write RUN/evaluation/: evaluation.json, evaluation.md, two plots of the path, views.png.

    Returns the figures (see `evaluate_outcome`). Raises InputError as that does, and for a run without poses, before
    anything is written.
    """
    outcome = load_outcome(run)
    result = evaluate_outcome(outcome, truth, progress, max_views, class_map) | {JUDGED: identity_of(outcome)}
    folder = run.evaluation_file.parent
    write_json(run.evaluation_file, result)
    write_text(folder / "evaluation.md", evaluation_table(result))
    matched = match_outcome(outcome, truth)
    top, side = trajectory_plots(outcome, matched)
    write_text(folder / PATH_FROM_ABOVE, top)
    write_text(folder / PATH_FROM_THE_SIDE, side)
    if outcome.gaussian_map is not None:
        write_rgb(folder / "views.png", comparison_sheet(outcome, matched))
    return result


def identity_of(outcome: Outcome) -> dict[str, str]:
    """Return the checksums of the poses, the map and the mesh that an evaluation of the outcome is about."""
    records = outcome.records
    stages = {"poses": outcome.pose_stage, "map": outcome.map_stage}
    identity = {what: records[stage].content for what, stage in stages.items() if stage}
    if "export" in records and MESH in records["export"].files:
        identity["mesh"] = records["export"].files[MESH][1]
    return identity


def trajectory_plots(outcome: Outcome, matched: MatchedTruth | None, upright: bool = False) -> tuple[str, str]:
    """SVGs of the camera path from above and from the side, with the truth where there is one.

    The axes are the path's own: its plane of largest extent is looked at from above; those of the world, where it
    is `upright`.
    """
    t = outcome.trajectory
    centers = np.where(t.is_posed[:, None], t.centers, np.nan)
    truth, unit = np.full_like(centers, np.nan), unit_name(outcome)
    if matched is not None and (both := t.is_posed & matched.has_pose).sum() >= 3:
        found = _aligned(
            centers[both], matched.world_from_cam[both, :3, 3], not (outcome.metric and matched.sequence.metric)
        )
        if found is not None:
            centers, truth = found.apply(centers), matched.world_from_cam[:, :3, 3]
            unit = "m" if matched.sequence.metric else FREE_UNIT
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
    rows = spread_sample(with_truth or posed.tolist(), views)
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


def evaluation_table(result: dict[str, Any], with_protocol: bool = True) -> str:
    """One row a figure, an empty cell says why; below, how each was measured."""
    lines = [f"# {result['run']} against {result['truth']}", ""]
    lines += markdown_table(TABLE_HEADER, evaluation_rows(result))
    if with_protocol:
        lines += ["", *(f"- {line}" for line in result["protocol"])]
    return "\n".join(lines) + "\n"


def evaluation_rows(result: dict[str, Any]) -> list[Row]:
    """The cells under `TABLE_HEADER`."""
    stage = result["stage"]
    frames = result["frames"]
    of = f"{frames['picked']} picked, {frames['keyframes']} keyframes, {frames['with true pose']} with a true pose"
    if "images" in frames:
        of += f"; of the source's {frames['images']} images {frames['images posed']} are posed"
    if frames.get("by rotation alone"):
        of += f"; {frames['by rotation alone']} by rotation alone, which no error of a place counts"
    rows = [("frames posed", str(frames["posed"]), of), _camera_row(result["camera"])]
    rows += _trajectory_rows(result["trajectory"], stage["poses"], result["unit"])
    rows += _scale_rows(result["scale"])
    if (psnr := result["keyframe psnr"]) is not None:
        rows.append(("PSNR at keyframes", f"{psnr:.2f} dB", "as in status and report: at the map's own image size"))
    rows += _image_rows(result["images"], stage["map"])
    rows += _depth_rows(result["depth"]) + _label_rows(result["labels"]) + _mesh_rows(result["mesh"])
    return rows + _cost_rows(result["cost"])


def _missing(name: str, group: dict[str, Any]) -> list[Row]:
    return [(name, "–", group["missing"])]


def _camera_row(camera: dict[str, Any]) -> Row:
    if "missing" in camera:
        return ("focal length", f"{camera['fx']:.1f} px", f"{camera['origin']}; {camera['missing']}")
    return ("focal length", f"{camera['fx']:.1f} px ({camera['focal error']:+.2%})", camera["origin"])


def _trajectory_rows(cells: dict[str, Any], stage: str, unit: str) -> list[Row]:
    if "missing" in cells:
        return _missing("trajectory", cells)
    rows = []

    def lengths(*values: float) -> str:
        if unit != "m":
            return " / ".join(f"{v:.3g}" for v in values) + f" {unit}"
        return " / ".join(f"{100 * v:.2f}" for v in values) + " cm"

    for key, name in (("sim3", "ATE Sim(3)"), ("se3", "ATE SE(3)")):
        for frames in ("all", "keyframes", "every image"):
            if (cell := cells.get(f"{key} {frames}")) is None:
                continue
            if "missing" in cell:
                rows += _missing(f"{name}, {frames}", cell)
                continue
            text = lengths(*(cell[k] for k in ("rmse", "mean", "median", "max")))
            scale = f", scale {cell['scale']:.4f}" if key == "sim3" else ""
            rows.append((f"{name}, {frames}: rmse / mean / median / max", text, f"{cell['frames']} frames{scale}"))
    rpe = cells["rpe"]
    text = f"{lengths(rpe['translation rmse'])}, {rpe['rotation rmse degrees']:.3f}°"
    return [*rows, ("RPE rmse", text, f"{rpe['pairs']} pairs, poses of {stage}")]


def _scale_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("metres per unit", cells)
    text = f"{cells['stated']:.4g} ± {cells['relative sd']:.1%}{', estimated' if cells['guess'] else ''}"
    return [("metres per unit", text, f"true {cells['true']:.4g}, {cells['sigmas']:.1f} sigmas off")]


def _image_rows(cells: dict[str, Any], stage: str) -> list[Row]:
    if "missing" in cells:
        return _missing("PSNR, SSIM", cells)
    rows: list[Row] = []
    for kind, cell in cells.items():
        if "missing" in cell:
            rows += _missing(f"PSNR, SSIM {kind}", cell)
            continue
        text = f"{_text(cell['psnr'], '.2f')} dB, {cell['ssim']:.4f}"
        rows.append((f"PSNR, SSIM {kind}", text, f"{cell['views']} views at full size, map of {stage}"))
    lpips = {kind: cell["lpips"] for kind, cell in cells.items() if "lpips" in cell}
    known = [f"{kind} {value:.4f}" for kind, value in lpips.items() if isinstance(value, float)]
    if known:
        return [*rows, ("LPIPS", ", ".join(known), "AlexNet")]
    return rows + [row for value in list(lpips.values())[:1] for row in _missing("LPIPS", value)]


def _depth_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("depth L1", cells)
    of = f"{cells['valid_fraction']:.1%} of the pixels with truth"
    metric = cells["metric_l1"]
    first = _missing("depth L1, metric", metric) if isinstance(metric, dict) else []
    first = first or [("depth L1, metric", f"{100 * metric:.2f} cm", of)]
    return [
        *first,
        ("depth L1, after one scale", f"{100 * cells['scaled_l1']:.2f} cm", f"{of}, × {cells['scale']:.4f}"),
    ]


def _label_rows(cells: dict[str, Any]) -> list[Row]:
    if "clustering" in cells:
        rows = _missing("mIoU, pixel accuracy", cells)
        for name, cell in cells["clustering"].items():
            text = f"{cell['mean_iou']:.2%}, {cell['pixel_accuracy']:.2%}"
            rows.append((f"as a clustering, {name} (classes named by the truth)", text, cells["input"]))
        return rows
    if "missing" in cells:
        return _missing("mIoU, pixel accuracy", cells)
    of = f"{cells['input']}, {cells['matching']}; over {len(cells['class_iou'])} classes of the truth"
    classes = ", ".join(f"{n} {v:.1%}" for n, v in sorted(cells["class_iou"].items(), key=lambda item: -item[1]))
    return [
        ("mIoU, pixel accuracy", f"{cells['mean_iou']:.2%}, {cells['pixel_accuracy']:.2%}", of),
        ("IoU of each class", classes, f"{cells['unlabelled']:.1%} of the pixels were given none of them"),
    ]


def _mesh_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return _missing("mesh", cells)
    text = f"{100 * cells['accuracy']:.2f} cm, {100 * cells['completeness']:.2f} cm, {cells['f_score']:.1%}"
    return [("mesh accuracy, completeness, F-score", text, f"F-score at {100 * cells['threshold']:.0f} cm")]


def _cost_rows(cells: dict[str, Any]) -> list[Row]:
    stages = ", ".join(f"{name} {s:.1f}" for name, s in cells["seconds"].items())
    return [
        ("time", f"{cells['total seconds']:.1f} s", f"{cells['frames per second']:.2f} frames/s; {stages}"),
        ("peak memory", f"{cells['peak memory MB']:.0f} MB", ""),
        ("map", f"{cells['gaussians']} Gaussians", f"{cells['map MB']:.1f} MB"),
    ]


def _text(value: Any, form: str = ".4f") -> str:
    return format(value, form) if isinstance(value, float) else ("–" if value is None else str(value))
