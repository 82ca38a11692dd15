"""One HTML file about a run that opens anywhere, without a network."""

from collections.abc import Iterable
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import write_text
from ...formats.datasets.sequence import distortion_names
from ...formats.glb import read_mesh_glb
from ...formats.reading import read_bytes
from ...formats.textfile import read_json, read_text
from ..config import SOURCE_LIST, Config, config_to_dict
from ..export.kinds import IMAGES, README, WEB_PAGE
from ..export.scene import lengths
from ..geometry.sparse_model import SparseModel
from ..run.files import FIGURES, LOOPS
from ..run.folder import RunFolder
from ..run.outcome import Outcome, load_outcome, spread_sample
from ..run.settings import config_to_toml
from ..run.target import LIST, Target
from ..scene.world import WORLD, in_world
from ..source.picking import at_most_wide
from ..system.progress import Progress, SilentProgress
from ..system.wording import figure_text, quoted
from ..types import VOID, LoopEdge
from .facts import advice, found_lengths, lost_stretches, read_capture
from .html import RED, Line, bullets, chips, drawing, image, legend, page, plot, section, table
from .views import Picture, common_depth_range, depth_picture, labels_on_photo, mesh_picture, render_outcome
from .write import JUDGED, PATH_FROM_ABOVE, TABLE_HEADER, evaluation_rows, identity_of, trajectory_plots, unit_name

SHOWN_VIEWS = 8
_TILE_WIDTH = 400
_ROWS = 3
"""Of four pictures, seen at once; the others unfold."""


def write_report(
    run: RunFolder, path: Path | None = None, progress: Progress | None = None, overwrite: bool = False
) -> Path:
    """Write RUN/report.html, or `path`; returns where. What has not been done yet is left out.

    overwrite: whether a file at `path` that is no earlier report may be replaced. Raises InputError for a run without
    poses, or such a file.
    """
    outcome, target = load_outcome(run), path or run.report_file
    place = Target(target.parent, overwrite or path is None)
    with place.replacing(target.name.__eq__) as staged:
        write_text(staged.path(target.name), _report(outcome, target, progress or SilentProgress()))
    return target


def _report(outcome: Outcome, target: Path, progress: Progress) -> str:
    """The HTML of the report that will be at `target`."""
    run = outcome.run
    sparse, loops = outcome.load_sparse(), run.load(LOOPS, "global_ba") if "global_ba" in outcome.records else []
    evaluation = read_json(run.evaluation_file) if run.evaluation_file.exists() else None
    body = "".join(
        [
            _heading(outcome, target),
            "" if outcome.gaussian_map is None else section("What the map shows", _map_section(outcome, progress)),
            _mesh_section(outcome),
            _advice_section(outcome, sparse, loops),
            _found_section(outcome, sparse, loops),
            _path_section(outcome),
            "" if evaluation is None else truth_section(evaluation, outcome),
            *(_piece_section(piece, progress) for piece in outcome.pieces()),
            _time_section(outcome),
            _export_section(outcome),
            _settings_section(outcome),
        ]
    )
    return page(f"{_title(outcome)} – report", body)


def _title(outcome: Outcome) -> str:
    """The name of the video or folder that was reconstructed; of several videos, and of a piece, that of the run."""
    run, source = outcome.run, Path(outcome.run.source.path).name
    return run.place.name if run.is_piece or source in ("", SOURCE_LIST) else source


def _figures(outcome: Outcome) -> list[tuple[str, str]]:
    t = outcome.trajectory
    pairs = [("frames posed", f"{int(t.is_posed.sum())} / {len(t.frame_ids)}")]
    if outcome.every is not None:
        pairs.append(("images of the source posed", f"{outcome.every.is_posed.sum()} / {len(outcome.every.frame_ids)}"))
    pairs.append(("keyframes", str(int(t.is_keyframe.sum()))))
    if outcome.gaussian_map is not None:
        pairs.append(("Gaussians", f"{len(outcome.gaussian_map):,}"))
    if outcome.keyframe_psnr is not None:
        size = outcome.calibration.intrinsics.at_most(outcome.config.mapping.max_side)
        pairs.append((f"keyframe PSNR, dB at {max(size.width, size.height)} pixels", f"{outcome.keyframe_psnr:.1f}"))
    return pairs


def _heading(outcome: Outcome, target: Path) -> str:
    pairs = _figures(outcome)
    if pieces := outcome.pieces():
        apart = sum(int(p.trajectory.is_posed.sum()) for p in pieces)
        pairs.append((f"frames in {len(pieces)} further {'piece' if len(pieces) == 1 else 'pieces'}", str(apart)))
    pairs.append(("seconds", f"{sum(r.seconds for r in outcome.records.values()):.0f}"))
    source = escape(str(outcome.run.source.path))
    after = _AFTER.get(outcome.map_stage or outcome.pose_stage, "")
    head, run = f'<h1>{escape(_title(outcome))}</h1><p class="sub">Source: {source}{after}</p>', outcome.run
    in_run = target.resolve().parent == run.root.resolve() and run.has("export", WEB_PAGE)
    link = f'<p><a href="export/{WEB_PAGE}">Open the map</a> (one file, easy to share).</p>' if in_run else ""
    return head + chips(pairs) + link


_AFTER = {
    "tracking": " (after tracking: no map yet)",
    "mapping": " (after mapping, before the global adjustment)",
    "global_ba": " (after global bundle adjustment)",
}


def _advice_section(outcome: Outcome, sparse: SparseModel | None, loops: list[LoopEdge]) -> str:
    warned = [f"{stage}: {w}" for stage, record in outcome.records.items() for w in record.warnings]
    lines = warned + advice(outcome, read_capture(outcome, sparse), sparse, loops, outcome.keyframe_psnr)
    if not lines:
        return section("What would improve it", "<p>No problem found in this capture.</p>", kind="fine")
    return section("What would improve it", bullets(lines), kind="advice")


def _mesh_section(outcome: Outcome) -> str:
    """The mesh from a few cameras of the path; nothing where there is none, or not as it was left."""
    run, name = outcome.run, "mesh.glb"
    if not run.has("export", name) or name in run.damaged("export") or (world := run.find(WORLD)) is None:
        return ""
    t, camera = outcome.moved(world.exported_from_run).trajectory, outcome.calibration.intrinsics.at_most(_TILE_WIDTH)
    mesh = read_mesh_glb(run.file("export", name))
    mesh = replace(mesh, vertices=(mesh.vertices @ world.gltf_from_exported).astype(np.float32))
    rows = spread_sample(np.flatnonzero(t.is_keyframe).tolist(), 4)
    shown = ((mesh_picture(mesh, t.cam_from_world[row], camera), f"mesh, {t.timestamps[row]:.2f} s") for row in rows)
    return section("The mesh", _tiles(shown))


def _tiles(pictures: Iterable[tuple[Picture, str]]) -> str:
    """Pictures in a grid, each above its caption."""
    tiles = (f"<div>{image(at_most_wide(p, _TILE_WIDTH), text)}{escape(text)}</div>" for p, text in pictures)
    return f'<div class="grid">{"".join(tiles)}</div>'


def _found_section(outcome: Outcome, sparse: SparseModel | None, loops: list[LoopEdge]) -> str:
    c, t = outcome.calibration, outcome.trajectory
    k = c.intrinsics
    spread = f" ± {c.focal_sd:.2f}" if c.focal_sd > 0 else ""
    shutter = f", rolling-shutter readout {1000 * sum(map(abs, c.readout)):.1f} ms" if any(c.readout) else ""
    scale = lengths(outcome.metres, outcome.metric)
    if outcome.metres is None and not outcome.metric and "export" not in outcome.records:
        scale = "free so far: the export says how many metres a unit is about"
    sides = f"centre ({k.cx:.1f}, {k.cy:.1f}), {k.width}×{k.height}{shutter}"
    rows = [
        ("camera", f"{c.origin}: focal length {k.fx:.2f}{spread} px, {sides}"),
        (
            "distortion removed",
            ", ".join(f"{n} {v:.4f}" for n, v in zip(distortion_names(c.fisheye), c.distortion, strict=False)),
        ),
        ("scale", scale),
        *found_lengths(outcome),
        ("depth", str(outcome.run.load(FIGURES["proxy"]).get("depth", ""))),
        ("classes", f"{outcome.semantics}: {len(outcome.classes)}"),
    ]
    if sparse is not None:
        rows.append(("sparse points", f"{len(sparse.points_in_world):,} with {len(sparse.obs_frame):,} observations"))
    if "global_ba" in outcome.records:
        text = ", ".join(f"{e.frame1_id}–{e.frame2_id} ({e.inliers} matches)" for e in loops[:12])
        rows.append(("loops", f"{len(loops)}: {text}" if loops else "none"))
    lost = lost_stretches(outcome)
    rows.append(("frames without a pose", f"{len(lost)} stretches, below" if lost else f"none of {len(t.frame_ids)}"))
    extra = f"<h3>Frames without a pose</h3>{bullets(lost)}" if lost else ""
    if share := outcome.records["frames"].figures.get("still_left_out"):
        rows.append(("stands still, left out", f"{share:.1%} of the image"))
        frame = outcome.frames[len(outcome.frames) // 2]
        photo, left_out = outcome.run.image(frame).copy(), outcome.run.left_out(frame)
        if left_out is not None:
            photo[left_out] = photo[left_out] // 2 + np.array([127, 0, 0], np.uint8)
        extra += _tiles([(photo, f"left out, {frame.timestamp:.2f} s")])
    return section("What was found", table(("", ""), rows), extra)


def _piece_section(piece: Outcome, progress: Progress) -> str:
    """A disconnected component: a run of its own inside the run, in short."""
    t = piece.trajectory
    seconds = f"{t.timestamps[0]:.1f} to {t.timestamps[-1]:.1f}"
    name = piece.run.place.name
    return section(
        f"Apart from the rest: {name.replace('_', ' ')}",
        chips([*_figures(piece), ("seconds of the source", seconds)]),
        "<p>It is not connected to the rest: it has a coordinate system and a unit of its own. "
        f"<code>msgs-slam report {escape(quoted(piece.run.root))}</code> says more; view and render take it, too.</p>",
        '<div class="two">', *trajectory_plots(piece, None), "</div>",
        "" if piece.gaussian_map is None else _map_section(piece, progress),
    )  # fmt: skip


def _path_section(outcome: Outcome) -> str:
    """In the axes of the exported files, where there are any."""
    world = outcome.run.find(WORLD) if "export" in outcome.records and outcome.move is None else None
    if world is not None:
        outcome = in_world(outcome, world)
    upright = world is not None and world.axes == "up"
    return section("Camera path", '<div class="two">', *trajectory_plots(outcome, None, upright), "</div>")


def truth_section(evaluation: dict[str, Any], outcome: Outcome) -> str:
    """The errors, of this very map only: an evaluation of what has been made again since would be read as of it."""
    run, identity = outcome.run, identity_of(outcome)
    if changed := [what for what, content in identity.items() if evaluation.get(JUDGED, {}).get(what) != content]:
        return section(
            "Compared with ground truth",
            f"<p>The evaluation was made for earlier {' and '.join(changed)}: "
            f"<code>msgs-slam evaluate {escape(quoted(run.root))} --truth PATH</code> makes it again.</p>",
        )
    errors = np.array(evaluation.get("frame errors", []), np.float64).reshape(-1, 2)
    drawn = ""
    if len(errors):
        per_unit, unit = (100.0, "cm") if evaluation["unit"] == "m" else (1.0, evaluation["unit"])
        points = np.stack([errors[:, 0], per_unit * errors[:, 1]], axis=1)
        drawn = plot("Distance from the true camera", "frame", unit, [Line(points, RED, "")])
    svg = run.evaluation_file.with_name(PATH_FROM_ABOVE)
    drawn += drawing(read_bytes(svg), "The camera path from above") if svg.exists() else ""
    return section(
        f"Compared with ground truth: {evaluation['truth']}",
        f'<div class="two">{drawn}</div>',
        table(TABLE_HEADER, evaluation_rows(evaluation)),
        "<details><summary>How this was measured</summary>", bullets(evaluation["protocol"]), "</details>",
    )  # fmt: skip


def _time_section(outcome: Outcome) -> str:
    rows = []
    for name, r in outcome.records.items():
        figures = ", ".join(f"{key} {figure_text(value, key)}" for key, value in r.figures.items())
        rows.append((name, f"{r.seconds:.1f}", f"{r.peak_memory_mb:.0f}", figures))
    return section("Stages", table(("stage", "seconds", "peak MB", "figures"), rows))


def _export_section(outcome: Outcome) -> str:
    if "export" not in outcome.records:
        return section("Files for other programs", "<p>Not exported yet.</p>")
    run, root = outcome.run, outcome.run.stage("export")
    written = root / README
    notes = f"<pre>{escape(read_text(written))}</pre>" if written.is_file() else ""
    sizes = {p.relative_to(root).as_posix(): _size(p.stat().st_size) for p in root.rglob("*") if p.is_file()}
    sizes |= {name: f"missing or damaged: msgs-slam resume {quoted(run.root)}" for name in run.damaged("export")}
    files = [row for row in sorted(sizes.items()) if row[0].partition("/")[0] not in (IMAGES, "masks", LIST)]
    return section("Files for other programs", notes, table(("in export/", "size"), files))


def _size(count: int) -> str:
    return f"{count / 1e6:.2f} MB" if count >= 10_000 else f"{count / 1e3:.1f} kB"


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


def _map_section(outcome: Outcome, progress: Progress) -> str:
    """Keyframes beside the map from the same place; colours of depth and of classes."""
    t, reach = outcome.trajectory, common_depth_range(outcome)
    rows = spread_sample(np.flatnonzero(t.is_keyframe).tolist(), SHOWN_VIEWS)
    pictures: list[tuple[Picture, str]] = []
    pixels = np.zeros(256, np.int64)
    for row in progress.track(rows, "rendering", len(rows)):
        frame, view = outcome.frames[row], render_outcome(outcome, t.cam_from_world[row])
        photo = outcome.run.image(frame)
        pixels += np.bincount(view.labels.ravel(), minlength=256)
        depth = depth_picture(view.depth, *reach)
        labels = labels_on_photo(photo, view.labels, outcome.classes.colors, view.certainty)
        shown = (photo, view.exposed(outcome.exposure, frame.timestamp), depth, labels)
        captions = (f"{what}, {frame.timestamp:.2f} s" for what in ("image", "map", "depth", "classes"))
        pictures += zip(shown, captions, strict=True)
    first, rest = pictures[: 4 * _ROWS], pictures[4 * _ROWS :]
    more = f"<details><summary>More views</summary>{_tiles(rest)}</details>" if rest else ""
    return _tiles(first) + more + _depth_scale(*reach, unit_name(outcome)) + _class_legend(outcome, pixels)


def _depth_scale(nearest: float, farthest: float, unit: str) -> str:
    """The colours of depth, with the depths of both ends and of the middle."""
    depths = 1 / np.linspace(1 / nearest, 1 / farthest, 9)
    colors = ",".join("rgb({},{},{})".format(*c) for c in depth_picture(depths[None], nearest, farthest)[0].tolist())
    low, middle, high = (f"{depths[k]:.2g}" for k in (0, 4, 8))
    bar = f'<i style="background:linear-gradient(to right,{colors})"></i>'
    middle = f"<span>(centre {middle})</span>"
    return f'<div class="legend scale">depth, {escape(unit)}: {low} {bar} {high} {middle}</div>'


def _class_legend(outcome: Outcome, pixels: NDArray[np.int64]) -> str:
    """Colour, name and share of each class by the pixels (256,) that have it, largest first."""
    shares = pixels / max(int(pixels.sum()), 1)
    rows = [
        (float(shares[i]), name, "rgb({},{},{})".format(*color))
        for i, (name, color) in enumerate(zip(outcome.classes.names, outcome.classes.colors, strict=True))
        if shares[i] > 0
    ]
    rows = [*sorted(rows, key=lambda row: -row[0]), (float(shares[VOID]), "unknown", "rgb(40,40,40)")]
    return legend([(name, color, f"{share:.1%}") for share, name, color in rows])
