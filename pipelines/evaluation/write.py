"""The evaluation on disk: figures, their table in Markdown, images; and the demo, which is evaluated with its truth."""

import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...formats.atomic import write_bytes, write_text
from ...formats.datasets import Dataset, open_sequence
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.textfile import write_json
from ...formats.video import VideoReader
from ..geometry.se3 import align_points
from ..run.files import MESH
from ..run.folder import RunFolder
from ..run.outcome import Outcome, load_outcome, spread_sample
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
TITLES = ("frame", "map", "depth of the map", "true depth", "error, white = 10%", "labels of the map", "true labels")


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
        true, is_metric = matched.world_from_cam[:, :3, 3], matched.sequence.metric
        with suppress(ValueError):  # a path along one line has no alignment; it is drawn as it is
            found = align_points(centers[both], true[both], not (outcome.metric and is_metric))
            centers, truth, unit = found.apply(centers), true, "m" if is_metric else FREE_UNIT
    axes = np.eye(3) if upright else _main_axes(centers[np.isfinite(centers).all(axis=1)])
    plots = []
    for name, x, y in (("Camera path from above", 0, 1), ("Camera path from the side", 0, 2)):
        lines = [Line(centers @ axes[[x, y]].T, BLUE, "this run")]
        # Rows without truth would tear the line: it is drawn over those that have one.
        if len(known := truth[np.isfinite(truth).all(axis=1)]):
            lines.insert(0, Line(known @ axes[[x, y]].T, GREY, "truth", dashed=True))
        plots.append(plot(name, unit, unit, lines, equal=True))
    return plots[0], plots[1]


def unit_name(outcome: Outcome) -> str:
    """Name the unit of length, with the estimated length in metres where the world is not metric."""
    if outcome.metric:
        return "m"
    return "units" if outcome.metres is None else f"units (1 ≈ {outcome.metres.per_unit:.2g} m)"


def _main_axes(points: np.ndarray) -> np.ndarray:
    """(3, 3) rows: directions of largest to smallest extent."""
    if len(points) < 3:
        return np.eye(3)
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2]
    # A fixed sign, so that the picture does not flip between two runs.
    return axes * np.where(axes[np.arange(3), np.abs(axes).argmax(axis=1)] < 0, -1, 1)[:, None]


def comparison_sheet(outcome: Outcome, matched: MatchedTruth, views: int = SHEET_VIEWS) -> Picture:
    """Rows of frame, rendering, depths and labels; of frames with truth where there are some."""
    posed = np.flatnonzero(outcome.trajectory.is_posed)
    with_truth = [int(r) for r in posed if matched.image[r] >= 0]
    rows = spread_sample(with_truth or posed.tolist(), views)
    pixels = FramePixels(outcome.calibration)
    return sheet([_pictures(outcome, matched, pixels, row) for row in rows], TITLES)


def _pictures(outcome: Outcome, matched: MatchedTruth, pixels: FramePixels, row: int) -> list[Picture]:
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


class _Figure(float):
    """A number of which "c" writes hundreds of: centimetres of a length in metres."""

    def __format__(self, form: str) -> str:
        return f"{100 * self:{form[:-1] or '.2'}f}" if form.endswith("c") else super().__format__(form)


def _row(name: str, cells: dict[str, Any], text: str, of: str = "") -> Row:
    """A row of the table, its texts filled in with the cells; why it is empty where it is."""
    if "missing" in cells:
        return (name, "–", cells["missing"])
    shown = {key: _Figure(v) if isinstance(v, float) else v for key, v in cells.items()}
    return (name, text.format_map(shown), of.format_map(shown))


def evaluation_rows(result: dict[str, Any]) -> list[Row]:
    """The cells under `TABLE_HEADER`."""
    frames, camera = result["frames"], result["camera"]
    of = "{picked} picked, {keyframes} keyframes, {with true pose} with a true pose"
    if "images" in frames:
        of += "; of the source's {images} images {images posed} are posed"
    rows = [_row("frames posed", frames, "{posed}", of)]
    why = camera.get("missing")
    known = {key: value for key, value in camera.items() if key != "missing"}
    px, origin = ("{fx:.1f} px", f"{{origin}}; {why}") if why else ("{fx:.1f} px ({focal error:+.2%})", "{origin}")
    rows += [_row("focal length", known, px, origin), *_trajectory_rows(result)]
    estimated = ", estimated" if result["scale"].get("guess") else ""
    stated = "{stated:.4g} ± {relative sd:.1%}" + estimated
    rows.append(_row("metres per unit", result["scale"], stated, "true {true:.4g}, {sigmas:.1f} sigmas off"))
    if (psnr := result["keyframe psnr"]) is not None:
        rows.append(("PSNR at keyframes", f"{psnr:.2f} dB", "as in status and report: up to 16, as the map is made"))
    rows += _image_rows(result["images"], result["stage"]["map"])
    rows += _depth_rows(result["depth"]) + _label_rows(result["labels"])
    name = "mesh" if "missing" in result["mesh"] else "mesh accuracy, completeness, F-score"
    mesh = "{accuracy:c} cm, {completeness:c} cm, {f_score:.1%}"
    rows.append(_row(name, result["mesh"], mesh, "F-score at {threshold:.0c} cm"))
    cost = result["cost"]
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in cost["seconds"].items())
    return [
        *rows,
        _row("time", cost, "{total seconds:.1f} s", f"{{frames per second:.2f}} frames/s; {stages}"),
        _row("peak memory", cost, "{peak memory MB:.0f} MB"),
        _row("map", cost, "{gaussians} Gaussians", "{map MB:.1f} MB"),
    ]


def _trajectory_rows(result: dict[str, Any]) -> list[Row]:
    cells, unit, stage = result["trajectory"], result["unit"], result["stage"]["poses"]
    if "missing" in cells:
        return [_row("trajectory", cells, "")]
    form, unit = ("c", "cm") if unit == "m" else (".3g", unit)
    names = ("rmse", "mean", "median", "max")
    values = " / ".join(f"{{{name}:{form}}}" for name in names) + f" {unit}"
    rows = []
    for key, name, scale in (("sim3", "ATE Sim(3)", ", scale {scale:.4f}"), ("se3", "ATE SE(3)", "")):
        for frames in ("all", "keyframes", "every image"):
            if (cell := cells.get(f"{key} {frames}")) is not None:
                title = f"{name}, {frames}" + ("" if "missing" in cell else f": {' / '.join(names)}")
                rows.append(_row(title, cell, values, "{frames} frames" + scale))
    text = f"{{translation rmse:{form}}} {unit}, {{rotation rmse degrees:.3f}}°"
    return [*rows, _row("RPE rmse", cells["rpe"], text, f"{{pairs}} pairs, poses of {stage}")]


def _image_rows(cells: dict[str, Any], stage: str) -> list[Row]:
    if "missing" in cells:
        return [_row("PSNR, SSIM", cells, "")]
    rows = []
    for kind, cell in cells.items():
        text = ("– dB" if cell.get("psnr") is None else "{psnr:.2f} dB") + ", {ssim:.4f}"
        rows.append(_row(f"PSNR, SSIM {kind}", cell, text, f"{{views}} views at full size, map of {stage}"))
    lpips = {kind: cell["lpips"] for kind, cell in cells.items() if "lpips" in cell}
    known = [f"{kind} {value:.4f}" for kind, value in lpips.items() if isinstance(value, float)]
    if known:
        return [*rows, ("LPIPS", ", ".join(known), "AlexNet")]
    return rows + [_row("LPIPS", value, "") for value in list(lpips.values())[:1]]


def _depth_rows(cells: dict[str, Any]) -> list[Row]:
    if "missing" in cells:
        return [_row("depth L1", cells, "")]
    of, metric = "{valid_fraction:.1%} of the pixels with truth", cells["metric_l1"]
    first = metric if isinstance(metric, dict) else cells
    return [
        _row("depth L1, metric", first, "{metric_l1:c} cm", of),
        _row("depth L1, after one scale", cells, "{scaled_l1:c} cm", of + ", × {scale:.4f}"),
    ]


def _label_rows(cells: dict[str, Any]) -> list[Row]:
    text = "{mean_iou:.2%}, {pixel_accuracy:.2%}"
    if "missing" in cells:
        rows = [_row("mIoU, pixel accuracy", cells, "")]
        for name, cell in cells.get("clustering", {}).items():
            rows.append(_row(f"as a clustering, {name} (classes named by the truth)", cell, text, cells["input"]))
        return rows
    of = f"{{input}}, {{matching}}; over {len(cells['class_iou'])} classes of the truth"
    classes = ", ".join(f"{n} {v:.1%}" for n, v in sorted(cells["class_iou"].items(), key=lambda item: -item[1]))
    return [
        _row("mIoU, pixel accuracy", cells, text, of),
        ("IoU of each class", classes, f"{cells['unlabelled']:.1%} of the pixels were given none of them"),
    ]


VIDEO, TRUTH = "room.mp4", "room_truth"
CLIP = Path(__file__).with_name("demo_clip")
"""The video, and its truth without the images as a zip: 36 frames of a made-up room (tests/world/demo_clip.py)."""


@dataclass(frozen=True)
class DemoResult:
    """The run of a demo and the figures of `evaluate_outcome`."""

    run: RunFolder
    figures: dict[str, Any]


def unpack_demo_clip(folder: Path, clip: Path = CLIP) -> tuple[Path, Path]:
    """Put the video and, in a folder beside it, its truth into `folder`; returns both paths. What is there stays.

    Raises InputError when the folder holds another video of that name or cannot be written.
    """
    video, truth, content = folder / VIDEO, folder / TRUTH, (clip / VIDEO).read_bytes()
    if video.exists():
        if video.read_bytes() != content:
            raise InputError(f"{video} is there already and is not the demo's. Choose another folder")
        return video, truth
    for frame in VideoReader(clip / VIDEO):
        write_rgb(truth / "rgb" / f"{frame.source_index:06d}.png", frame.rgb)
    with zipfile.ZipFile(clip / f"{TRUTH}.zip") as archive:
        archive.extractall(truth)
    write_bytes(video, content)  # last: where it is, the truth is whole
    return video, truth


def run_demo(
    folder: Path, reconstruct: Callable[[Path, RunFolder], Any], progress: Progress, clip: Path = CLIP
) -> DemoResult:
    """Unpack the clip, have it reconstructed from the video alone (`reconstruct(video, run)`), evaluate the run.

    The truth is opened only after the reconstruction has ended. Raises InputError as the steps do.
    """
    video, truth = unpack_demo_clip(folder, clip)
    run = RunFolder(folder / "room.msgs")
    reconstruct(video, run)
    figures = write_evaluation(run, open_sequence(truth), progress)
    return DemoResult(run, figures)


def demo_summary(result: DemoResult) -> list[str]:
    """Return a few lines for a person: the errors, and where to look."""
    figures, folder = result.figures, result.run.evaluation_file.parent
    frames, camera, depth, psnr = (figures[key] for key in ("frames", "camera", "depth", "keyframe psnr"))
    ate = figures["trajectory"].get("sim3 all", figures["trajectory"])
    path = None if "missing" in ate else f"camera path: {100 * ate['rmse']:.2f} cm RMSE after Sim(3)"
    lines = [f"{frames['posed']} of {frames['picked']} frames posed", path or f"no camera path: {ate['missing']}"]
    if psnr is not None:
        lines.append(f"map: {psnr:.1f} dB PSNR at keyframes")
    if "focal error" in camera:
        lines.append(f"focal length: {camera['focal error']:+.2%} off ({camera['origin']})")
    if "scaled_l1" in depth:
        lines.append(f"depth: {100 * depth['scaled_l1']:.1f} cm mean error after one scale")
    return [*lines, f"images: {folder / 'views.png'}", f"tables: {folder / 'evaluation.md'}"]
