"""Options and small helpers that several commands share."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from pipelines.progress import Progress
    from pipelines.run_folder import RunFolder

FOLDER = click.Path(path_type=Path, file_okay=False)
RUN_ARGUMENT = click.argument("run_path", metavar="RUN", type=FOLDER)


def verbosity_options(command: Callable[..., None]) -> Callable[..., None]:
    """-q and -v."""
    command = click.option("-v", "--verbose", is_flag=True, help="Log what is decided and why.")(command)
    return click.option("-q", "--quiet", is_flag=True, help="No bars and no table; only errors.")(command)


def settings_options(command: Callable[..., None]) -> Callable[..., None]:
    """--config and --set."""
    command = click.option(
        "--set", "overrides", multiple=True, metavar="SECTION.KEY=VALUE",
        help="Change one setting, e.g. --set frames.rate=5; may be repeated.",
    )(command)  # fmt: skip
    return click.option(
        "--config", "config_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
        help="Settings in TOML; `msgs-slam config` prints one to start from.",
    )(command)  # fmt: skip


def set_up_logging(quiet: bool, verbose: bool) -> None:
    """Logs go to stderr: warnings, or everything, or errors only."""
    if quiet and verbose:
        raise click.UsageError("-q and -v exclude each other")
    level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(levelname)s: %(message)s", stream=sys.stderr, force=True)


def make_progress(quiet: bool) -> Progress:
    """Bars on stderr, or nothing."""
    from msgs_cli.progress import BarProgress
    from pipelines.progress import SilentProgress

    return SilentProgress() if quiet else BarProgress()


def open_run(path: Path) -> RunFolder:
    """Raises InputError for a folder that is no run."""
    from pipelines.reconstruct import require_run
    from pipelines.run_folder import RunFolder

    run = RunFolder(path)
    require_run(run)
    return run
