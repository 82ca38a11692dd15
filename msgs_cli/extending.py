"""`msgs-slam extend`: more videos for a finished run."""

from pathlib import Path

import click

from ..pipelines.system.wording import quoted
from .options import RUN_ARGUMENT
from .output import Output, verbosity_options
from .summary import tell_run


@click.command()
@RUN_ARGUMENT
@click.argument("videos", metavar="VIDEO...", nargs=-1, required=True, type=click.Path(path_type=Path))
@verbosity_options
def extend(run_path: Path, videos: tuple[Path, ...], output: Output) -> None:
    """Add VIDEO, by the same camera and of the same place, to the finished RUN.

    First a few images of it are looked for in the run: where nothing is recognised, or the camera is another one, that
    is said and nothing is changed. Then its frames join those of the run, whose poses are the start, all are adjusted
    together, and the map is grown where the added frames look. Coordinates stay what they were, as near as the
    adjustment allows. Stopped, the same command or `msgs-slam resume RUN` goes on.
    """
    from ..pipelines.reconstruct import extend as extend_run
    from ..pipelines.run.folder import RunFolder

    run = RunFolder(run_path)
    with output.stopping_softly(f"Resume with: msgs-slam resume {quoted(run.root)}"):
        records = extend_run(run, videos, output.progress())
    tell_run(output, run.root, records)
