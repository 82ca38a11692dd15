"""One HTML file about a run that opens anywhere, without a network."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ...formats.atomic import write_text
from ...formats.datasets.camera import distortion_names
from ...formats.jsonfile import read_json
from ...formats.reading import read_bytes
from ..config import Config, config_to_dict
from ..export.readme import lengths, readme
from ..export.stage import on_earth
from ..export.writers import IMAGES
from ..geometry.sparse_model import SparseModel
from ..outcome import Outcome, load_outcome
from ..read_config import config_to_toml
from ..run.files import FIGURES, LOOPS
from ..run.folder import RunFolder
from ..run.records import load_source
from ..scene.world import FIRST, WORLD
from ..system.progress import Progress, SilentProgress
from ..system.wording import figure_text, quoted
from ..types import LoopEdge
from .facts import Capture, advice, lost_stretches, read_capture
from .html import bullets, chips, drawing, page, section, table
from .lengths import found_lengths
from .plots import RED, Line, plot
from .report_views import RenderedViews, class_legend, quality_section, render_views
from .table import TABLE_HEADER, evaluation_rows
from .write import PATH_FROM_ABOVE, trajectory_plots


def write_report(run: RunFolder, path: Path | None = None, progress: Progress | None = None) -> Path:
    """Write RUN/report.html, or `path`; returns where. What has not been done yet is left out.

    Raises InputError for a run without poses.
    """
    outcome = load_outcome(run)
    sparse, loops = outcome.load_sparse(), _load_loops(outcome)
    capture = read_capture(outcome, sparse)
    views = None if outcome.gaussian_map is None else render_views(outcome, progress or SilentProgress())
    evaluation = read_json(run.evaluation_file) if run.evaluation_file.exists() else None
    body = "".join(
        [
            _heading(outcome, views, loops),
            "" if views is None else section("What the map shows", views.sheet, class_legend(outcome, views)),
            _advice_section(outcome, capture, sparse, loops, views),
            _found_section(outcome, sparse, loops),
            _path_section(outcome),
            quality_section(outcome, capture, views),
            "" if evaluation is None else _truth_section(evaluation, run),
            *(_piece_section(piece, progress or SilentProgress()) for piece in outcome.pieces()),
            _time_section(outcome),
            _export_section(outcome),
            _settings_section(outcome),
        ]
    )
    target = path or run.report_file
    write_text(target, page(f"{run.root.name} – report", body))
    return target


def _load_loops(outcome: Outcome) -> list[LoopEdge]:
    return outcome.run.load(LOOPS) if "global_ba" in outcome.records else []


def _figures(outcome: Outcome, views: RenderedViews | None) -> list[tuple[str, str]]:
    t = outcome.trajectory
    pairs = [("frames posed", f"{int(t.is_posed.sum())} / {len(t.frame_ids)}")]
    if t.by_rotation.any():
        pairs.append(("of them by rotation alone", str(int(t.by_rotation.sum()))))
    pairs.append(("keyframes", str(int(t.is_keyframe.sum()))))
    if outcome.gaussian_map is not None:
        pairs.append(("Gaussians", f"{len(outcome.gaussian_map):,}"))
    if views is not None and views.psnr:
        pairs.append(("keyframe PSNR, dB", f"{np.mean(views.psnr):.1f}"))
    return pairs


def _heading(outcome: Outcome, views: RenderedViews | None, loops: list[LoopEdge]) -> str:
    pairs = [*_figures(outcome, views), ("focal length, px", f"{outcome.calibration.intrinsics.fx:.1f}")]
    if pieces := outcome.pieces():
        apart = sum(int(p.trajectory.is_posed.sum()) for p in pieces)
        pairs.append((f"frames in {len(pieces)} further {'piece' if len(pieces) == 1 else 'pieces'}", str(apart)))
    if "global_ba" in outcome.records:
        pairs.append(("loops closed", str(len(loops))))
    pairs.append(("seconds", f"{sum(r.seconds for r in outcome.records.values()):.0f}"))
    source = escape(str(load_source(outcome.run).path))
    after = _AFTER.get(outcome.map_stage or outcome.pose_stage, "")
    return f'<h1>{escape(outcome.run.root.name)}</h1><p class="sub">Source: {source}{after}</p>{chips(pairs)}'


_AFTER = {
    "tracking": " (after tracking: no map yet)",
    "mapping": " (after mapping, before the global adjustment)",
    "global_ba": " (after global bundle adjustment)",
}


def _advice_section(
    outcome: Outcome, capture: Capture, sparse: SparseModel | None, loops: list[LoopEdge], views: RenderedViews | None
) -> str:
    lines = advice(outcome, capture, sparse, loops, float(np.mean(views.psnr)) if views and views.psnr else None)
    if not lines:
        return section("What would improve it", "<p>No problem found in this capture.</p>", kind="fine")
    return section("What would improve it", bullets(lines), kind="advice")


def _found_section(outcome: Outcome, sparse: SparseModel | None, loops: list[LoopEdge]) -> str:
    c, t = outcome.calibration, outcome.trajectory
    k = c.intrinsics
    spread = f" ± {c.focal_sd:.2f}" if c.focal_sd > 0 else ""
    shutter = f", rows within {1000 * sum(map(abs, c.readout)):.1f} ms" if any(c.readout) else ""
    sides = f"centre ({k.cx:.1f}, {k.cy:.1f}), {k.width}×{k.height}{shutter}"
    rows = [
        ("camera", f"{c.origin}: focal length {k.fx:.2f}{spread} px, {sides}"),
        (
            "distortion removed",
            ", ".join(f"{n} {v:.4f}" for n, v in zip(distortion_names(c.fisheye), c.distortion, strict=False)),
        ),
        ("scale", _scale_text(outcome)),
        *found_lengths(outcome),
        ("depth", str(outcome.run.load(FIGURES["proxy"]).get("depth", ""))),
        ("classes", f"{outcome.semantics}: {len(outcome.classes)}"),
    ]
    if sparse is not None:
        rows.append(("sparse points", f"{len(sparse.points_in_world):,} with {len(sparse.obs_frame):,} observations"))
    if "global_ba" in outcome.records:
        text = ", ".join(f"{e.frame1_id}–{e.frame2_id} ({e.inliers} matches)" for e in loops[:12])
        rows.append(("loops", f"{len(loops)}: {text}" if loops else "none"))
    lost = [f"frames {s.first}–{s.last} ({s.start:.2f}–{s.end:.2f} s): {s.reason}" for s in lost_stretches(outcome)]
    rows.append(("frames without a pose", f"{len(lost)} stretches, below" if lost else f"none of {len(t.frame_ids)}"))
    warnings = [f"{stage}: {w}" for stage, record in outcome.records.items() for w in record.warnings]
    listed = {"Frames without a pose": lost, "Warnings": warnings}
    extra = "".join(f"<h3>{title}</h3>{bullets(lines)}" for title, lines in listed.items() if lines)
    return section("What was found", table(("", ""), rows), extra)


def _scale_text(outcome: Outcome) -> str:
    if outcome.metres is not None or outcome.metric:
        return lengths(outcome.metres, outcome.metric)
    exported = "export" in outcome.records
    return lengths(None, False) if exported else "free so far: the export says how many metres a unit is about"


def _piece_section(piece: Outcome, progress: Progress) -> str:
    """A disconnected component: a run of its own inside the run, in short."""
    views = None if piece.gaussian_map is None else render_views(piece, progress)
    t = piece.trajectory
    seconds = f"{t.timestamps[0]:.1f} to {t.timestamps[-1]:.1f}"
    name = piece.run.root.name
    return section(
        f"Apart from the rest: {name.replace('_', ' ')}",
        chips([*_figures(piece, views), ("seconds of the source", seconds)]),
        "<p>It is not connected to the rest: it has a coordinate system and a unit of its own. "
        f"<code>msgs-slam report {escape(quoted(piece.run.root))}</code> says more; view and render take it, too.</p>",
        '<div class="two">', *trajectory_plots(piece, None), "</div>", "" if views is None else views.sheet,
    )  # fmt: skip


def _path_section(outcome: Outcome) -> str:
    """In the axes of the exported files, where there are any."""
    world = outcome.run.find(WORLD) if "export" in outcome.records and outcome.move is None else None
    if world is not None:
        outcome = on_earth(outcome.moved(world.exported_from_run), world)
    upright = world is not None and world.axes == "up"
    return section("Camera path", '<div class="two">', *trajectory_plots(outcome, None, upright), "</div>")


def _truth_section(evaluation: dict[str, Any], run: RunFolder) -> str:
    errors = np.array(evaluation.get("frame errors", []), np.float64).reshape(-1, 2)
    drawn = ""
    if len(errors):
        points = np.stack([errors[:, 0], 100 * errors[:, 1]], axis=1)
        drawn = plot("Distance from the true camera", "frame", "cm", [Line(points, RED, "")])
    beside = run.evaluation_file.with_name(PATH_FROM_ABOVE)
    drawn += drawing(read_bytes(beside), "The camera path from above") if beside.exists() else ""
    return section(
        f"Against the truth: {evaluation['truth']}",
        f'<div class="two">{drawn}</div>',
        table(TABLE_HEADER, evaluation_rows(evaluation)),
        "<details><summary>How this was measured</summary>", bullets(evaluation["protocol"]), "</details>",
    )  # fmt: skip


def _time_section(outcome: Outcome) -> str:
    rows = [
        (
            name,
            f"{r.seconds:.1f}",
            f"{r.peak_memory_mb:.0f}",
            ", ".join(f"{key} {figure_text(value, key)}" for key, value in r.figures.items()),
        )
        for name, r in outcome.records.items()
    ]
    return section("Stages", table(("stage", "seconds", "peak MB", "figures"), rows))


def _export_section(outcome: Outcome) -> str:
    if "export" not in outcome.records:
        return section("Files for other programs", "<p>Not exported yet.</p>")
    files = [row for row in files_of_export(outcome.run) if Path(row[0]).parts[0] != IMAGES]
    notes = readme(outcome.run.find(WORLD) or FIRST, outcome.metres, outcome.metric)
    return section("Files for other programs", f"<pre>{escape(notes)}</pre>", table(("in export/", "size"), files))


def files_of_export(run: RunFolder) -> list[tuple[str, str]]:
    """Name and size of the files of the stage, or that one is not as the stage left it, and of those that
    `msgs-slam export --only` has added since. Reads all of them."""
    root = run.stage("export")
    wrong = {name: f"damaged or gone: msgs-slam resume {quoted(run.root)}" for name in run.damaged("export")}
    sizes = {p.relative_to(root).as_posix(): f"{p.stat().st_size / 1e6:.2f} MB" for p in root.rglob("*") if p.is_file()}
    return sorted((sizes | wrong).items())


def _settings_section(outcome: Outcome) -> str:
    used, default = config_to_dict(outcome.config), config_to_dict(Config())
    changed = [
        (f"{s}.{k}", str(v), str(default[s][k]))
        for s, values in used.items()
        if s == "run" or s in outcome.records
        for k, v in values.items()
        if v != default[s][k]
    ]
    listed = table(("setting", "here", "default"), changed) if changed else "<p>All at their defaults.</p>"
    title = "All settings (of stages that are not done: those of run.toml)"
    whole = f"<details><summary>{title}</summary><pre>{escape(config_to_toml(outcome.config))}</pre></details>"
    return section("Settings", listed, whole)
