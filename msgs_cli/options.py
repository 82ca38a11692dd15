"""Options and small helpers that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..pipelines.config import STAGES, Option, settings_with_options

if TYPE_CHECKING:
    from ..pipelines.config import Config
    from ..pipelines.run.cluster import RayCluster
    from ..pipelines.run.folder import RunFolder
    from .output import Output


class Folder(click.Path):
    """A folder, there or not. The empty name of an unset shell variable would be the working folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse an empty name, then check as click does."""
        if value == "":
            self.fail("the name is empty; the working folder is .", param, ctx)
        return super().convert(value, param, ctx)


FOLDER = Folder(path_type=Path, file_okay=False)
RUN_ARGUMENT = click.argument("run_path", metavar="RUN", type=click.Path(path_type=Path))
_HOLD_OUT, _QUALITY = "mapping.hold_out", "run.quality"
UNTIL = click.option("--until", type=click.Choice(STAGES), default=STAGES[-1], help="Stop after this stage.")

OVERWRITE = click.option(
    "--overwrite", is_flag=True,
    help="Replace existing files even if msgs-slam has not written them, or they were changed since. Without it the "
    "command refuses to.",
)  # fmt: skip


def settings_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options --config and --set to a command."""
    command = click.option(
        "--set", "overrides", multiple=True, metavar="SECTION.KEY=VALUE",
        help="Change one setting, e.g. --set frames.rate=5; may be repeated.",
    )(command)  # fmt: skip
    return click.option(
        "--config", "config_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
        help="Settings in TOML; `msgs-slam config` prints one to start from.",
    )(command)  # fmt: skip


def engine_options(help: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that adds the options --engine and --address."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        command = click.option(
            "--address", default="", metavar="HOST:PORT", help="Join this Ray cluster. Default: this machine alone."
        )(command)
        engines = click.Choice(["local", "ray"])
        return click.option("--engine", "engine_name", type=engines, default="local", show_default=True, help=help)(
            command
        )

    return decorate


@contextmanager
def open_cluster(name: str, address: str, config: Config, output: Output) -> Iterator[RayCluster | None]:
    """The Ray cluster that takes the tasks of a command in this block, None for this process."""
    if name == "local":
        if address:
            raise click.UsageError("`--address` needs `--engine ray`")
        yield None
        return
    from ..pipelines.run.cluster import RayCluster

    cluster = RayCluster(address, config.run.threads, int(config.run.device == "cuda"), not output.quiet)
    try:
        yield cluster
    finally:
        cluster.close()


def setting_option(key: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that adds the option of a setting, as the table of settings describes it."""
    known = settings_with_options()[key]
    option: Option = known.metadata["option"]
    text = known.metadata["help"]
    default = f". Default: {known.default}." if known.default != "" else "."
    return click.option(
        f"--{option.name}", key.replace(".", "__"), type=int if isinstance(known.default, int) else str,
        metavar=option.metavar or "|".join(known.metadata["choices"]), help=text[0].upper() + text[1:] + default,
    )  # fmt: skip


def source_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that describe the source of a reconstruction, and its results; see `chosen_config`."""
    for key in reversed(settings_with_options()):
        if key != _HOLD_OUT:
            command = setting_option(key)(command)
    return command


hold_out_option = setting_option(_HOLD_OUT)
device_option = setting_option("run.device")
quality_option = setting_option(_QUALITY)


def chosen_config(
    file: Path | None, overrides: Iterable[str], given: Mapping[str, str | int | None], base: Config | None = None
) -> Config:
    """Read the settings that a command line gives; raises SettingError, in the words that were typed.

    Args:
        file: of --config.
        overrides: of --set.
        given: of the options of settings, by `section__key`; None where one is not given.
        base: what holds where nothing is given; None for the defaults.
    """
    from ..pipelines.run.settings import load_config, merge_settings

    quality = given.get("run__quality")
    config = load_config(file, overrides, base, None if quality is None else str(quality))
    for key, known in settings_with_options().items():
        section, _, name = key.partition(".")
        if key != _QUALITY and (value := given.get(f"{section}__{name}")) is not None:
            config = merge_settings(config, {section: {name: value}}, f"--{known.metadata['option'].name}")
    return config


def use_threads(run: RunFolder | None = None) -> None:
    """Let the libraries of this process use as many CPU threads as the run's settings say, or all that there are: a
    container's share, not its machine's."""
    from ..pipelines.system.machine import available_cpus
    from ..pipelines.system.threads import limit_threads

    limit_threads((run.settings().run.threads if run is not None else 0) or available_cpus())


def open_run(path: Path) -> RunFolder:
    """Raises InputError for a folder that is no run."""
    from ..pipelines.run.folder import RunFolder

    return RunFolder(path).required()
