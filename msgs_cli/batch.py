"""`msgs-slam batch`: a run for every recording of a folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import (
    FOLDER,
    UNTIL,
    engine_options,
    require_engine,
    settings_options,
    source_options,
    source_settings,
)
from .output import Output, verbosity_options
from .text import say

if TYPE_CHECKING:
    from ..pipelines.engine.engines import LocalEngine, RayEngine


@click.command()
@click.argument("folder", type=FOLDER)
@click.option("--out", "-o", type=FOLDER, required=True, metavar="RUNS", help="Of the runs, batch.json and batch.md.")
@engine_options("local: one recording after the other; ray: as many at once as the cluster has room for.")
@click.option("--shard", default="0/1", metavar="K/N", help="Every N-th recording only, the K-th from 0 on.")
@settings_options
@source_options
@UNTIL
@verbosity_options
def batch(
    folder: Path,
    out: Path,
    engine_name: str,
    address: str,
    shard: str,
    config_file: Path | None,
    overrides: tuple[str, ...],
    until: str,
    output: Output,
    **about_source: str | None,
) -> None:
    """Reconstruct every video, image folder and data set in FOLDER, a run each, and go on after failures.

    Prints one table; the exit code is 1 where a recording failed, and RUNS/NAME.failed.txt says why. The same command
    goes on where it was stopped. With --shard many machines share the work over one disk (SLURM arrays, Kubernetes
    indexed jobs, AWS Batch: docs/batch.md).
    """
    require_engine(engine_name, address)
    from ..formats.jsonfile import read_toml
    from ..pipelines.batch import find_recordings, run_batch, table_rows, write_table
    from ..pipelines.engine.shards import Shard
    from ..pipelines.read_config import load_config

    recordings = find_recordings(folder.resolve(), out.resolve())
    mine = Shard.parse(shard).of(recordings)
    settings = read_toml(config_file) if config_file else {}
    texts = (*overrides, *source_settings(about_source))
    config = load_config(config_file, texts)
    out.mkdir(parents=True, exist_ok=True)
    engine, cpus, threads = _open_engine(engine_name, address, config.run.threads)
    gpus = int(config.run.device == "cuda")
    prepare = output.worker_setup(remote=engine_name == "ray")
    try:
        with output.stopping_softly("The same command goes on with it."):
            failed = run_batch(mine, engine, settings, texts, until, prepare, cpus, gpus, threads)
    finally:
        rows = table_rows(recordings)
        write_table(out, rows)
        if engine_name == "ray":
            engine.close()  # type: ignore[union-attr]
    if not output.quiet:
        _print(rows)
    if failed:
        say(f"{len(failed)} of {len(mine)} recordings failed; {out}/NAME.failed.txt says why", err=True)
    runs = {"runs": [r.run for r in mine], "failed": [r.run for r in failed]}
    output.tell_result(int(bool(failed)), table=out / "batch.json", **runs)
    if failed:
        sys.exit(1)


def _open_engine(name: str, address: str, threads: int) -> tuple[LocalEngine | RayEngine, int, int]:
    """The engine, the CPUs of a recording, and the threads that follow: as many on every node, or the results would
    differ; 0 for all of the machine's."""
    from ..pipelines.engine.engines import LocalEngine, RayEngine

    if name == "local":
        return LocalEngine(), 1, threads
    engine = RayEngine(address)
    cpus = threads or engine.smallest_node
    return engine, cpus, cpus


def _print(rows: list[dict[str, object]]) -> None:
    from ..pipelines.system.wording import figure_text
    from .tables import format_table, terminal_width

    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[figure_text(row[c]) if c in row else "" for c in columns] for row in rows]
    say(format_table(columns, cells, terminal_width()))
