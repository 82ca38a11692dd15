"""Commands on the results of a run: status, evaluate, report, render, view."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..formats.errors import InputError
from ..pipelines.system.wording import figure_text, quoted
from .options import OVERWRITE, RUN_ARGUMENT, open_run, use_threads
from .output import Output, format_table, on_sigterm, say, terminal_width, verbosity_options, was_shown

if TYPE_CHECKING:
    from ..pipelines.run.reads import StageRecord
    from ..pipelines.run.status import StageStatus

KEY_FIGURES = {
    "frames": ("frames", "keyframes_placed", "calibration", "focal_px", "focal_sd_px", "still_left_out", "gps"),
    "proxy": ("depth", "semantics", "metric", "metres_per_unit", "classes"),
    "tracking": ("posed", "keyframes", "lost", "links", "scale"),
    "mapping": ("gaussians", "keyframe_psnr", "psnr_pixels"),
    "global_ba": ("images_posed", "keyframe_psnr"),
    "export": ("images", "vertices", "faces", "up", "floor", "gps"),
}
"""What a person wants to know first; `status -v` says all."""


@click.command()
@RUN_ARGUMENT
@click.option("-v", "--verbose", is_flag=True, help="Every figure of every stage.")
@click.option("--json", "as_json", is_flag=True, help="The same as JSON, with every figure.")
def status(run_path: Path, verbose: bool, as_json: bool) -> None:
    """Show which stages of RUN are done, what they found, what was degraded, and which files are damaged.

    \b
    Example: msgs-slam status video.msgs
    """
    from ..pipelines.reconstruct import all_stages
    from ..pipelines.run.status import run_status

    run = open_run(run_path)
    found = run_status(run, all_stages)
    if as_json:
        click.echo(json.dumps(found.to_json(), indent=1))
        return
    say(f"{run.root}: made from {found.source}\n")
    say(status_table(found.stages, verbose))
    records = {s.name: s.record for s in found.stages if s.record}
    whole = {s.name: s.record for s in found.stages if s.record and not s.damaged}
    for line in scale_lines(run.root, whole):
        say(line)
    for line in [*(f"warning: {w}" for w in found.warnings), *warning_lines(records), *found.notes]:
        say(line)


@click.command("list")
@RUN_ARGUMENT
@click.option("--json", "as_json", is_flag=True, help="The same as JSON: all of things.json.")
@click.option("--csv", "as_csv", is_flag=True, help="The same as comma-separated values.")
def list_things(run_path: Path, as_json: bool, as_csv: bool) -> None:
    """List the things that were found in RUN: names, sizes, and how sure each is.

    \b
    Example: msgs-slam list video.msgs
    """
    run = open_run(run_path)
    from ..pipelines.export.inventory import THINGS, inventory_csv

    if (things := run.find(THINGS)) is None:
        raise InputError(
            f"{run.root} has no list of its things: run `msgs-slam resume {quoted(run.root)} --redo export`"
        )
    if as_json:
        click.echo(json.dumps(THINGS.pack(things), indent=1))
    elif as_csv:
        click.echo(inventory_csv(things), nl=False)
    elif not things:
        say("No things were found: the mesh shows walls, floors and ceilings alone.")
    else:
        head = ["thing", "width x depth x height", "views", "faces", "a thing", "so called"]
        rows = [
            [t.name, t.size_text, str(t.views), str(t.faces), f"{100 * t.sure:.0f}%", t.called_text] for t in things
        ]
        say(format_table(head, rows, terminal_width()))


@click.command()
@RUN_ARGUMENT
@click.option(
    "--truth", required=True, type=click.Path(path_type=Path, exists=True), metavar="PATH",
    help="A data set with true poses and, if it has them, depth and labels.",
)  # fmt: skip
@click.option("--format", "truth_format", default="auto", help="Layout of the ground truth; auto recognises it.")
@click.option(
    "--class-map", metavar="FILE|NAME",
    help="A TOML from the run's classes to those of the ground truth. Default: a built-in one that fits.",
)  # fmt: skip
@verbosity_options
def evaluate(run_path: Path, truth: Path, truth_format: str, class_map: str | None, output: Output) -> None:
    """Compare RUN with ground truth: poses, images, depth, labels, mesh. Writes RUN/evaluation/.

    \b
    Example: msgs-slam evaluate msgs-demo/room.msgs --truth msgs-demo/room_truth
    """
    from ..formats.datasets import open_sequence

    joins = None
    if class_map:
        from ..pipelines.evaluation.labels import open_class_map

        joins = open_class_map(class_map)
    run = open_run(run_path)
    sequence = open_sequence(truth, truth_format)
    from ..pipelines.evaluation.write import evaluation_table, write_evaluation

    use_threads(run)
    folder = run.evaluation_file.parent
    with on_sigterm(signal.SIG_DFL):
        figures = write_evaluation(run, sequence, output.progress(), class_map=joins)
    say(evaluation_table(figures, with_protocol=False))
    output.report_result(evaluation=folder)


@click.command()
@RUN_ARGUMENT
@click.option(
    "--to",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where to write it. Default: report.html in the run.",
)
@OVERWRITE
@verbosity_options
def report(run_path: Path, to: Path | None, overwrite: bool, output: Output) -> None:
    """Write one HTML file that says what was found, how good it is, and what to film better.

    \b
    Example: msgs-slam report video.msgs --to report.html
    """
    if to is not None and to.suffix.lower() == ".pdf":
        raise click.UsageError(f"--to {to}: a report is an HTML file, {to.with_suffix('.html')}; print it in a browser")
    run = open_run(run_path)
    from ..pipelines.evaluation.report import write_report

    use_threads(run)
    with on_sigterm(signal.SIG_DFL):
        page = write_report(run, to, output.progress(), overwrite)
    say(page)
    output.report_result(report=page)


class Size(click.ParamType):
    """Parameter type of an image size, written as 640x480."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """(width, height) of at least 16 and at most 8192 pixels each."""
        found = re.fullmatch(r"(\d{2,4})[xX×](\d{2,4})", value) if isinstance(value, str) else None
        sides = (int(found[1]), int(found[2])) if found else (0, 0)
        if not all(16 <= side <= 8192 for side in sides):
            self.fail(f"{value!r}: expected width and height in pixels, 16 to 8192, like 1280x720", param, ctx)
        return sides


@click.command()
@RUN_ARGUMENT
@click.argument("target", metavar="VIDEO|FOLDER", type=click.Path(path_type=Path))
@click.option(
    "--kind", default="color", show_default=True, type=click.Choice(["color", "depth", "labels"]),
    help="What is drawn.",
)  # fmt: skip
@click.option(
    "--path", "camera_path", default="smooth", show_default=True, metavar="own|smooth|orbit|FILE",
    help="The run's own camera path, the same path smoothed, an arc around the scene on the filmed side, or a "
    "path saved in `view`.",
)  # fmt: skip
@click.option(
    "--fps", type=click.FloatRange(0.1, 240), help="Images per second. Default: 30, or as the path's FILE says."
)
@click.option(
    "--size", type=Size(), metavar="WIDTHxHEIGHT", help="Pixels of the images. Default: those of the run's frames."
)
@OVERWRITE
@verbosity_options
def render(
    run_path: Path, target: Path, kind: str, camera_path: str, fps: float | None, size: tuple[int, int] | None,
    overwrite: bool, output: Output,
) -> None:  # fmt: skip
    """Render the map of RUN along a camera path into a video or a folder of images.

    An .mp4 is H.264 where PyAV is installed (the extra [hdr]), else VP9: browsers play both. .avi and
    .mkv are lossless (FFV1).

    \b
    Example: msgs-slam render video.msgs orbit.mp4 --path orbit
    """
    run = open_run(run_path)
    from ..pipelines.evaluation.film import render_run

    use_threads(run)
    with on_sigterm(signal.SIG_DFL):
        made = render_run(run, target, kind, camera_path, fps, output.progress(), size, output.report, overwrite)
    say(made)
    output.report_result(video=made)


@click.command()
@RUN_ARGUMENT
@click.option("--port", default=0, type=click.IntRange(0, 65535), help="Port to serve on. Default: any free one.")
def view(run_path: Path, port: int) -> None:
    """View RUN in the browser: serve the page of its map to this machine only.

    An unfinished run shows the results of its finished stages, and updates as soon as another one ends.

    \b
    Example: msgs-slam view video.msgs
    """
    run = open_run(run_path)
    from ..pipelines.evaluation.serve import PageServer

    use_threads(run)
    try:
        with on_sigterm(signal.default_int_handler), PageServer(run, port) as server:
            say(f"open {server.url} in a browser; Ctrl-C ends it", err=True)
            server.serve_forever()
    except KeyboardInterrupt:
        return


def status_table(stages: Sequence[StageStatus], everything: bool = False) -> str:
    """One row a stage: state, seconds, peak memory, key figures or all of them."""
    rows = []
    for stage in stages:
        if (record := stage.record) is None:
            rows.append([stage.name, stage.state_text, "", "", ""])
            continue
        wanted = record.figures if everything else [k for k in KEY_FIGURES[stage.name] if k in record.figures]
        figures = ", ".join(f"{key} {figure_text(record.figures[key], key)}" for key in wanted)
        rows.append([stage.name, stage.state, f"{record.seconds:.1f}", f"{record.peak_memory_mb:.0f}", figures])
    return format_table(["stage", "state", "seconds", "peak MB", "figures"], rows, terminal_width())


def scale_lines(root: Path, records: dict[str, StageRecord]) -> list[str]:
    """Return the line about the scale of the world; none before the export has estimated it."""
    from ..pipelines.run.files import METRES
    from ..pipelines.run.folder import RunFolder

    metres = RunFolder(root).find(METRES) if "export" in records else None
    return [] if metres is None else [f"\nScale: {metres.text}"]


def warning_lines(records: dict[str, StageRecord], was_shown: Callable[[str], bool] = lambda text: False) -> list[str]:
    """Every degraded result, by stage, that is not said yet."""
    return [
        f"warning ({n}): {text}" for n, record in records.items() for text in record.warnings if not was_shown(text)
    ]


def report_run(output: Output, root: Path, records: dict[str, Any]) -> None:
    """Say how the run is now, for people unless they want errors only, and for programs."""
    if not output.quiet:
        print_summary(root, records)
    output.report_result(run=root, **({"export": root / "export"} if "export" in records else {}))


def print_summary(root: Path, records: dict[str, Any]) -> None:
    """Print the table, what is not said yet, and where the results are."""
    from ..pipelines.run.status import DONE, StageStatus

    say(status_table([StageStatus(name, DONE, record) for name, record in records.items()]))
    for line in warning_lines(records, was_shown):
        say(line, err=True)
    for line in scale_lines(root, records):
        say(line)
    if "export" in records:
        say(f"\nResults: {root / 'export'} (README.txt there says what each file is for)")
        if (page := root / "export" / "map.html").exists():
            say(f"Open in a browser: {page}")
