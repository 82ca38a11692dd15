"""`msgs-slam batch` and `work`: a run for every recording of a folder, and one of many processes at one run."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from ..pipelines.system.wording import quoted
from .options import (
    FOLDER,
    RUN_ARGUMENT,
    UNTIL,
    chosen_config,
    engine_options,
    open_run,
    option_words,
    require_engine,
    settings_options,
    source_options,
)
from .output import Output, say, verbosity_options

if TYPE_CHECKING:
    from ..pipelines.config import Config
    from ..pipelines.engine.placement import LocalPlacement, RayCluster


@click.command()
@click.argument("folder", type=FOLDER)
@click.option(
    "--out", "-o", type=FOLDER, required=True, metavar="RUNS", help="Folder for the runs, batch.json and batch.md."
)
@engine_options("local: one recording after the other; ray: as many at once as the cluster has room for.")
@click.option("--shard", default="0/1", metavar="K/N", help="Process recordings K, K+N, K+2N, ... only (K from 0).")
@click.option("--placed", nargs=2, hidden=True, help="Reconstruct NAME from SOURCE in this process: of a placement.")
@click.option("--threads", type=int, default=0, hidden=True, help="Where the settings leave them open.")
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
    placed: tuple[str, str] | None,
    threads: int,
    config_file: Path | None,
    overrides: tuple[str, ...],
    until: str,
    output: Output,
    **given: str | int | None,
) -> None:
    """Reconstruct every video, image folder and data set in FOLDER, a run each, and go on after failures.

    Prints one table; the exit code is 1 where a recording failed, and RUNS/NAME.failed.txt says why. The same command
    goes on where it was stopped. With --shard many machines share the work over one disk (SLURM arrays, Kubernetes
    indexed jobs, AWS Batch: docs/batch.md).
    """
    require_engine(engine_name, address)
    from ..pipelines.batch import find_recordings, run_batch, table_row, write_table
    from ..pipelines.engine.tasks import Shard

    if placed:
        read = partial(chosen_config, config_file, overrides, given)
        _reconstruct_one(placed, out, read, until, threads, output)
    recordings = find_recordings(folder.resolve(), out.resolve())
    mine = Shard.parse(shard).of(recordings)
    config = chosen_config(config_file, overrides, given)
    out.mkdir(parents=True, exist_ok=True)
    placement, cpus, threads = _open_placement(engine_name, address, config.run.threads)
    options = ["--until", until, "--threads", str(threads), *output.options]
    options += option_words(given, overrides, config)
    options += [] if config_file is None else ["--config", str(config_file.resolve())]
    try:
        with output.stopping_softly("The same command goes on with it."):
            failed = run_batch(mine, placement, options, cpus, int(config.run.device == "cuda"))
    finally:
        write_table(out, rows := [table_row(r) for r in recordings])
        if engine_name == "ray":
            placement.close()  # type: ignore[union-attr]
    if not output.quiet:
        _print(rows)
    if failed:
        say(f"{len(failed)} of {len(mine)} recordings failed; {out}/NAME.failed.txt says why", err=True)
    runs = {"runs": [r.run for r in mine], "failed": [r.run for r in failed]}
    output.report_result(int(bool(failed)), table=out / "batch.json", **runs)
    if failed:
        sys.exit(1)


def _reconstruct_one(
    placed: tuple[str, str], out: Path, read: Callable[[Config | None], Config], until: str, threads: int,
    output: Output,
) -> NoReturn:  # fmt: skip
    """Do the recording that a placement has started this process for; the one that started it says what became of
    it."""
    from ..pipelines.batch import FAILED, Recording, reconstruct_one
    from ..pipelines.engine.placement import stop_with_parent
    from ..pipelines.system.progress import log

    name, source = placed
    stop_with_parent()
    log.info("%s: begins", name)
    recording = Recording(name, Path(source), out / f"{name}.msgs")
    with output.stopping_softly(""):
        state = reconstruct_one(recording, read, output.progress(name), until, threads)
    log.info("%s: %s", name, state)
    sys.exit(int(state == FAILED))


def _open_placement(name: str, address: str, threads: int) -> tuple[LocalPlacement | RayCluster, int, int]:
    """The placement, the CPUs of a recording, and the threads that follow: as many on every node, or the results would
    differ; 0 for all of the machine's."""
    from ..pipelines.engine.placement import LocalPlacement, RayCluster

    if name == "local":
        return LocalPlacement(), 1, threads
    cluster = RayCluster(address)
    cpus = threads or cluster.smallest_node
    return cluster, cpus, cpus


def _print(rows: list[dict[str, object]]) -> None:
    from ..pipelines.system.wording import figure_text
    from .output import format_table, terminal_width

    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[figure_text(row[c]) if c in row else "" for c in columns] for row in rows]
    say(format_table(columns, cells, terminal_width()))


@click.command()
@RUN_ARGUMENT
@click.option("--shard", required=True, metavar="K/N", help="This process is the K-th, from 0 on, of about N.")
@click.option("--placed", is_flag=True, hidden=True, help="Take tasks only, as long as the process that started it.")
@UNTIL
@verbosity_options
def work(run_path: Path, shard: str, placed: bool, until: str, output: Output) -> None:
    """Process RUN together with other workers, on this machine or others that see the folder.

    Begin the run with `msgs-slam reconstruct SOURCE --out RUN --until frames`, with all settings, run.threads among
    them. Then any number of processes, in any order and at any time, finish it together; each starts with its own share
    of the tasks. A single process is enough, and the others take over the tasks of one that is killed. For SLURM
    arrays, Kubernetes indexed jobs and AWS Batch: docs/batch.md.
    """
    from ..pipelines.engine.placement import stop_with_parent
    from ..pipelines.engine.tasks import Shard
    from ..pipelines.reconstruct import work_on_run
    from ..pipelines.run.folder import load_settings

    chosen, run = Shard.parse(shard), open_run(run_path)
    if placed:
        stop_with_parent()
    hint = f"The same command goes on, or without others: msgs-slam resume {quoted(run.root)}"
    with output.stopping_softly("" if placed else hint):
        work_on_run(run, chosen, load_settings(run), output.task_progress, until, placed)
    output.report_result(run=run.root)
