"""`msgs-slam`: a plain video in; camera poses, a semantic Gaussian map and a labelled mesh out."""

import errno
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

# Spinning OpenMP threads of one library steal the cores of the next; must be set before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from ..formats.errors import InputError, SettingError
from ..pipelines.config import STAGES
from ..pipelines.export.kinds import EXPORTS, KIND_OF, kinds_help
from ..pipelines.system.wording import quoted
from . import results
from .batch import batch
from .doctor import doctor
from .models import models
from .options import (
    FOLDER,
    OVERWRITE,
    RUN_ARGUMENT,
    UNTIL,
    chosen_config,
    device_option,
    engine_options,
    hold_out_option,
    open_cluster,
    open_run,
    quality_option,
    settings_options,
    source_options,
    use_threads,
)
from .output import (
    Interrupted,
    Output,
    flush_output,
    is_asked_for,
    json_outcome,
    on_sigterm,
    prepare_streams,
    printable,
    program,
    say,
    verbosity_options,
)


class FriendlyGroup(click.Group):
    """Prints an InputError as one message with exit code 1, or 2 where an option or setting cannot be; a bug keeps its
    traceback. Where `--log-format json` is asked for, all that is JSON lines."""

    def main(self, args: Sequence[str] | None = None, *rest: Any, **more: Any) -> Any:
        """Run the command line, as click does."""
        words = sys.argv[1:] if args is None else list(args)
        if not is_asked_for(words):
            return super().main(args, *rest, **more)
        with json_outcome():
            sys.exit(super().main(args, *rest, **more | {"standalone_mode": False}))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, or say which one a file or folder in its place is meant for."""
        path = Path(args[0])
        if self.get_command(ctx, args[0]) is None and (path.suffix or path.exists()):
            for_run = path.suffix == ".msgs" or (path / "manifest.json").exists()
            meant = f"{'resume' if for_run else 'reconstruct'} {quoted(path)}"
            ctx.fail(f"{args[0]!r} is no command; did you mean `msgs-slam {meant}`?")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Leave out the list: the help text has a line for every command."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command inside the one error boundary."""
        try:
            result = super().invoke(ctx)
            flush_output()
            return result
        except InputError as error:
            kind = SettingRefused if isinstance(error, SettingError) else click.ClickException
            raise kind(printable(str(error))) from error
        except KeyboardInterrupt as error:
            raise Interrupted("stopped by Ctrl-C") from error
        except SystemError as error:
            if "with an exception set" not in str(error):  # so numba says where Ctrl-C met a kernel
                raise
            raise Interrupted("stopped by Ctrl-C") from error
        except RuntimeError as error:
            if not str(error).startswith("Symlink loop"):  # so pathlib says it
                raise
            raise click.ClickException(printable(f"{error}: a link that leads to itself. Remove it")) from error
        except OSError as error:
            if error.errno not in _SYSTEM_REFUSES:
                raise
            where = error.filename or "the output"
            raise click.ClickException(
                printable(f"{where}: {error.strerror}. Change that, then run it again")
            ) from error


class SettingRefused(click.ClickException):
    """Ends as a wrong option does."""

    exit_code = click.UsageError.exit_code


class KindOfFile(click.Choice[str]):
    """The kinds of `export --only`, by the names of their formats too."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Take a format's name for its kind, then check as click does."""
        return super().convert(KIND_OF.get(str(value).lower(), value), param, ctx)


_SYSTEM_REFUSES = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG}
"""What the user can do something about: rights, room, names."""


@click.group(cls=FriendlyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="msgs-slam")
def main() -> None:
    """Turn an ordinary video into camera poses, a semantic 3D Gaussian map and a labelled mesh.

    \b
    msgs-slam demo                      try it on a small synthetic room (about 3 CPU minutes)
    msgs-slam reconstruct video.mp4     the whole job; writes video.msgs/
    msgs-slam resume video.msgs         resume an interrupted run
    msgs-slam extend RUN more.mp4       extend a finished run with another video
    msgs-slam batch FOLDER --out RUNS   many recordings, on one machine or many
    msgs-slam status video.msgs         what is done, what was found
    msgs-slam list video.msgs           the things that were found, with their sizes
    msgs-slam export video.msgs         write more kinds of files, or elsewhere
    msgs-slam report video.msgs         one HTML page: what was found, how good, what to film better
    msgs-slam render video.msgs out.mp4 the map along its camera path
    msgs-slam view video.msgs           the map in the browser
    msgs-slam evaluate video.msgs ...   errors against ground truth
    msgs-slam models list               learned models for metric depth and named classes
    msgs-slam doctor                    check this machine and suggest fixes
    msgs-slam config                    every setting with its default and meaning
    msgs-slam completion bash           shell completion of commands and options
    """
    prepare_streams()


@main.command("reconstruct")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", "-o", type=FOLDER, metavar="RUN", help="The run folder. Default: the source's name + .msgs, here."
)
@settings_options
@source_options
@UNTIL
@hold_out_option
@engine_options("local: all in this process; ray: keyframes' depths and submaps on the nodes of a cluster.")
@verbosity_options
def reconstruct_command(
    sources: tuple[Path, ...], out: Path | None, config_file: Path | None, overrides: tuple[str, ...], until: str,
    engine_name: str, address: str, output: Output, **given: str | int | None,
) -> None:  # fmt: skip
    """Reconstruct SOURCE, a video, a folder of images or a data set, into a run folder; several videos of one place
    from one camera become one run.

    No option is needed. If interrupted, run the same command, or `msgs-slam resume RUN`, to continue; with a changed
    setting only the stages that depend on it run again.

    \b
    Example: msgs-slam reconstruct video.mp4 --quality draft
    """
    from ..pipelines.reconstruct import default_run_folder, existing_config, one_source, reconstruct
    from ..pipelines.run.folder import RunFolder

    run = RunFolder(out) if out else default_run_folder(sources[0])
    config = chosen_config(config_file, overrides, given, existing_config(run))
    with (
        open_cluster(engine_name, address, config, output) as workers,
        output.stopping_softly(f"Resume with: msgs-slam resume {quoted(run.root)}"),
    ):
        records = reconstruct(one_source(sources, run), run, config, output.progress(), until, workers)
    results.report_run(output, run.root, records)


@main.command("resume")
@RUN_ARGUMENT
@click.option(
    "--redo", type=click.Choice(STAGES),
    help="Run this stage and all later ones again, with the networks that are installed now; run.toml stays as it is.",
)  # fmt: skip
@settings_options
@quality_option
@device_option
@UNTIL
@engine_options("local: all in this process; ray: keyframes' depths and submaps on the nodes of a cluster.")
@verbosity_options
def resume_command(
    run_path: Path, redo: str | None, config_file: Path | None, overrides: tuple[str, ...], until: str,
    engine_name: str, address: str, output: Output, **given: str | int | None,
) -> None:  # fmt: skip
    """Resume RUN where it stopped. Finished stages are kept unless one of their settings is changed, or --redo names
    them. A stage that is run again replaces its old output only if it succeeds.

    \b
    Example: msgs-slam resume video.msgs --quality normal
    """
    if redo and STAGES.index(redo) > STAGES.index(until):
        raise click.UsageError(f"--redo {redo} comes after --until {until}: nothing would be made again")
    from ..pipelines.reconstruct import resume
    from ..pipelines.run.folder import RunFolder

    run = RunFolder(run_path).required()
    config = chosen_config(config_file, overrides, given, run.settings())
    with (
        open_cluster(engine_name, address, config, output) as workers,
        output.stopping_softly(f"Resume with: msgs-slam resume {quoted(run.root)}"),
    ):
        records = resume(run, output.progress(), config, until, workers, redo=redo or "")
    results.report_run(output, run.root, records)


@main.command("extend")
@RUN_ARGUMENT
@click.argument("videos", metavar="VIDEO...", nargs=-1, required=True, type=click.Path(path_type=Path))
@verbosity_options
def extend_command(run_path: Path, videos: tuple[Path, ...], output: Output) -> None:
    """Add VIDEO, filmed with the same camera in the same place, to the finished RUN.

    The run is computed again from all its videos, starting from the known poses as with --poses. All poses are adjusted
    together, and the result is aligned to the old ones, so that coordinates stay the same as closely as the adjustment
    allows. If interrupted, run the same command or `msgs-slam resume RUN` to continue.

    \b
    Example: msgs-slam extend video.msgs kitchen.mp4
    """
    from ..pipelines.reconstruct import extend
    from ..pipelines.run.folder import RunFolder

    run = RunFolder(run_path)
    with output.stopping_softly(f"Resume with: msgs-slam resume {quoted(run.root)}"):
        records = extend(run, videos, output.progress())
    results.report_run(output, run.root, records)


_EXPORT_HELP = f"""Export a finished RUN to files for other programs. The files that every run writes are in RUN/export
and stay as they are.

\b
Kinds for --only, and settings (--set export.NAME=VALUE) of each:
{kinds_help()}

The settings apply to the files written now; `msgs-slam resume RUN --set ...` changes them in the run itself.

\b
Example: msgs-slam export video.msgs --only ply --to shared
"""


@main.command(help=_EXPORT_HELP)
@RUN_ARGUMENT
@click.option(
    "--only", type=KindOfFile([row.kind for row in EXPORTS]), metavar="KIND",
    help="Write one kind of file only. Default: all kinds that every run writes.",
)  # fmt: skip
@click.option(
    "--only-things", default="", metavar="NAMES",
    help='Write these things alone, such as "chair 2,table": names as `list` says them, or classes for all of a kind.',
)  # fmt: skip
@click.option(
    "--without", default="", metavar="NAMES",
    help='Leave these things out, such as "person,sofa 1"; floor and walls continue where they stood.',
)  # fmt: skip
@click.option("--to", type=FOLDER, metavar="DIR", help="Where to write. Default: RUN/exports/KIND, or all.")
@OVERWRITE
@settings_options
@verbosity_options
def export(
    run_path: Path, only: str | None, only_things: str, without: str, to: Path | None, overwrite: bool,
    config_file: Path | None, overrides: tuple[str, ...], output: Output,
) -> None:  # fmt: skip
    """Write exports, as the help above says."""
    if others := [text for text in overrides if not text.startswith("export.")]:
        raise click.UsageError(
            f"--set {others[0]}: an export has the settings of [export] alone; of the rest of the run: "
            f"msgs-slam resume {quoted(run_path)} --set {quoted(others[0])}"
        )
    from ..pipelines.reconstruct import made_with
    from ..pipelines.run.settings import load_config, with_absolute_paths

    run = open_run(run_path)
    from ..pipelines.export.stage import export_folder, export_run

    use_threads(run)
    settings = with_absolute_paths(load_config(config_file, overrides, base=made_with(run))).export
    folder = to or export_folder(run, only)
    with on_sigterm(signal.SIG_DFL):
        written = export_run(run, folder, only, output.progress(), settings, overwrite, only_things, without)
    for path in written:
        if not output.quiet:
            say(path)
    output.report_result(export=folder, files=written)


@main.command()
@click.option(
    "--out", "-o", type=FOLDER, default=Path("msgs-demo"), metavar="DIR", show_default=True,
    help="Where the clip, its ground truth and the run are written.",
)  # fmt: skip
@settings_options
@device_option
@verbosity_options
def demo(
    out: Path, config_file: Path | None, overrides: tuple[str, ...], output: Output, **given: str | int | None
) -> None:
    """Reconstruct a synthetic test clip and print its errors against ground truth.

    \b
    Example: msgs-slam demo --out /tmp/demo
    """
    config = chosen_config(config_file, overrides, given)
    from ..pipelines.evaluation.write import demo_summary, run_demo
    from ..pipelines.reconstruct import reconstruct
    from ..pipelines.run.folder import RunFolder

    def reconstruct_clip(video: Path, run: RunFolder) -> None:
        with output.stopping_softly(f"Resume with: msgs-slam resume {quoted(run.root)}"):
            records = reconstruct(video, run, config, output.progress())
        if not output.quiet:
            results.print_summary(run.root, records)

    result = run_demo(out, reconstruct_clip, output.progress())
    root = result.run.root
    say("\nCompared with ground truth:")
    for line in demo_summary(result):
        say(f"  {line}")
    say(f"\nNext:\n  {program()} view {quoted(root)}      # the map in your browser")
    say(f"  {program()} report {quoted(root)}    # one HTML page: what was found, and how good it is")
    say(f"  {program()} reconstruct video.mp4 # your own video, or a folder of images")
    output.report_result(run=root, export=root / "export", evaluation=root / "evaluation")


@main.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print a shell completion script.

    \b
    Example: msgs-slam completion bash >> ~/.bashrc
    """
    from click.shell_completion import get_completion_class

    found = get_completion_class(shell)
    if found is not None:
        click.echo(found(main, {}, "msgs-slam", "_MSGS_SLAM_COMPLETE").source())


@main.command("config")
@settings_options
def show_config(config_file: Path | None, overrides: tuple[str, ...]) -> None:
    """Print every setting as commented TOML: save it, change it, pass it with --config.

    \b
    Example: msgs-slam config --set frames.rate=5 > my.toml
    """
    from ..pipelines.run.settings import config_to_toml, load_config

    click.echo(config_to_toml(load_config(config_file, overrides)), nl=False)


for command in (results.status, results.list_things, results.evaluate, results.report, results.render, results.view):
    main.add_command(command)
main.add_command(models)
main.add_command(batch)
main.add_command(doctor)

if __name__ == "__main__":
    main()
