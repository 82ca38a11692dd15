"""`msgs-slam batch`: a run for every recording of a folder."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import click

from .options import (
    FOLDER,
    UNTIL,
    chosen_config,
    engine_options,
    open_cluster,
    settings_options,
    source_options,
)
from .output import Output, say, verbosity_options


def _share(context: click.Context, option: click.Parameter, text: str) -> slice:
    """The recordings of a share such as 3/16, counted from 0."""
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise click.BadParameter(f"{text}: expected K/N with K from 0 to N - 1, for example 3/16")
    return slice(int(index), None, int(count))


@click.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--out", "-o", type=FOLDER, required=True, metavar="RUNS", help="Folder for the runs, batch.json and batch.md."
)
@engine_options("local: one recording after the other; ray: as many at once as the cluster has room for.")
@click.option(
    "--shard", default="0/1", metavar="K/N", callback=_share,
    help="Process recordings K, K+N, K+2N, ... only (K from 0).",
)  # fmt: skip
@settings_options
@source_options
@UNTIL
@verbosity_options
def batch(
    folder: Path, out: Path, engine_name: str, address: str, shard: slice, config_file: Path | None,
    overrides: tuple[str, ...], until: str, output: Output, **given: str | int | None,
) -> None:  # fmt: skip
    """Reconstruct every video, image folder and data set in FOLDER, each into its own run; the rest go on if one fails.

    Prints one table; the exit code is 1 if a recording failed, and RUNS/NAME.failed.txt says why. If interrupted, run
    the same command to continue. With --shard many machines share the work over one disk (SLURM arrays, Kubernetes
    indexed jobs, AWS Batch: docs/batch.md).

    \b
    Example: msgs-slam batch videos --out runs --quality draft
    """
    from ..pipelines.reconstruct import find_recordings, run_batch, table_row, write_table

    recordings = find_recordings(folder.resolve(), out.resolve())
    read = partial(chosen_config, config_file, overrides, given)
    with open_cluster(engine_name, address, read(), output) as cluster:
        out.mkdir(parents=True, exist_ok=True)
        try:
            with output.stopping_softly("Run the same command to continue."):
                failed = run_batch(recordings[shard], read, until, output.task_progress, cluster)
        finally:
            write_table(out, rows := [table_row(r) for r in recordings])
    if not output.quiet:
        _print(rows)
    if failed:
        say(f"{len(failed)} of {len(recordings[shard])} recordings failed; {out}/NAME.failed.txt says why", err=True)
    runs = {"runs": [r.run for r in recordings[shard]], "failed": [r.run for r in failed]}
    output.report_result(int(bool(failed)), table=out / "batch.json", **runs)
    sys.exit(int(bool(failed)))


def _print(rows: list[dict[str, object]]) -> None:
    from ..pipelines.system.wording import figure_text
    from .output import format_table, terminal_width

    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[figure_text(row[c]) if c in row else "" for c in columns] for row in rows]
    say(format_table(columns, cells, terminal_width()))
