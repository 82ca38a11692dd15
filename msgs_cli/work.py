"""`msgs-slam work`: one of many processes at one run."""

from pathlib import Path

import click

from ..pipelines.system.wording import quoted
from .options import RUN_ARGUMENT, UNTIL, open_run
from .output import Output, verbosity_options


@click.command()
@RUN_ARGUMENT
@click.option("--shard", required=True, metavar="K/N", help="This process is the K-th, from 0 on, of about N.")
@click.option("--placed", is_flag=True, hidden=True, help="Take tasks only, as long as the process that started it.")
@UNTIL
@verbosity_options
def work(run_path: Path, shard: str, placed: bool, until: str, output: Output) -> None:
    """Work on RUN beside other processes that do the same, on this machine or others that see the folder.

    Begin the run with `msgs-slam reconstruct SOURCE --out RUN --until frames`, with all settings, run.threads among
    them. Then any number of processes, in any order and at any time, bring it to its end together, each its own share
    of the tasks first; one alone would do all. What a killed one was at is done by the others. For SLURM arrays,
    Kubernetes indexed jobs and AWS Batch: docs/batch.md.
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
    output.tell_result(run=run.root)
