"""Options and small helpers that several commands share."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from msgs_slam.msgs_cli.json_lines import JsonHandler, JsonProgress, write_line
from msgs_slam.msgs_cli.text import TextHandler, say
from msgs_slam.pipelines.run.names import STAGES

if TYPE_CHECKING:
    from msgs_slam.pipelines.config import Config
    from msgs_slam.pipelines.engine.workers import Workers
    from msgs_slam.pipelines.run.folder import RunFolder
    from msgs_slam.pipelines.system.progress import Progress

FOLDER = click.Path(path_type=Path, file_okay=False)
RUN_ARGUMENT = click.argument("run_path", metavar="RUN", type=click.Path(path_type=Path))


UNTIL = click.option("--until", type=click.Choice(STAGES), default=STAGES[-1], help="Stop after this stage.")
LOG_FORMAT = "msgs_slam.msgs_cli.log_format"


def _keep_format(ctx: click.Context, parameter: click.Parameter, value: str) -> None:
    ctx.meta[LOG_FORMAT] = value


def _as_json() -> bool:
    ctx = click.get_current_context(silent=True)
    return ctx is not None and ctx.meta.get(LOG_FORMAT) == "json"


def verbosity_options(command: Callable[..., None]) -> Callable[..., None]:
    """-q, -v and --log-format."""
    command = click.option(
        "--log-format", type=click.Choice(["text", "json"]), default="text", expose_value=False, callback=_keep_format,
        help="json: progress, logs and errors on stderr as one JSON object a line.",
    )(command)  # fmt: skip
    command = click.option("-v", "--verbose", is_flag=True, help="Log what is decided and why.")(command)
    return click.option("-q", "--quiet", is_flag=True, help="Print errors only.")(command)


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


def require_engine(name: str, address: str) -> None:
    """Refuse an address that nobody would join."""
    if address and name != "ray":
        raise click.UsageError("--address is of --engine ray")


@contextmanager
def cluster_workers(
    name: str, address: str, config: Config, quiet: bool, verbose: bool
) -> Iterator[tuple[Workers | None, Config]]:
    """The workers that take a run's tasks, None for this process, each with as many threads, or the results would
    differ; and the settings, as they were asked for: the next process may work elsewhere."""
    require_engine(name, address)
    if name == "local":
        yield None, config
        return
    from msgs_slam.pipelines.engine.engines import RayEngine
    from msgs_slam.pipelines.engine.workers import Workers

    engine = RayEngine(address)
    try:
        threads = config.run.threads or engine.smallest_node
        setup, gpus = worker_setup(quiet, verbose, True), int(config.run.device == "cuda")
        yield Workers(engine, setup, threads, gpus, engine.room(threads)), config
    finally:
        engine.close()


_SOURCE_OPTIONS = {
    "format": (
        "run.format", "NAME",
        "Kind of SOURCE: auto, images (a video or plain images, whatever is next to them), or a data set: 7scenes, "
        "replica, tum, euroc, scannet, sens, nerfstudio, colmap, folder. Default: auto. A data set gives its times and "
        "camera, and with --depth files --semantics files its depth and labels.",
    ),
    "device": ("run.device", "auto|cpu|cuda", "Where dense work runs. Default: auto."),
    "depth": (
        "proxy.depth", "PROVIDER",
        "Proxy depth: auto, multiview (needs no weights), files[:FOLDER], onnx:CARD, or a network by its name in "
        "`models list`. Default: auto.",
    ),
    "semantics": (
        "proxy.semantics", "PROVIDER",
        "Semantics: auto, segments (needs no weights), files[:FOLDER], onnx:CARD, or a network by its name. "
        "Default: auto.",
    ),
    "classes": (
        "proxy.classes", "WORDS",
        'What to look for, "radiator, bookshelf, lamp", by a --semantics network whose card names a text encoder.',
    ),
    "intrinsics": (
        "frames.intrinsics", "FX,FY,CX,CY[,K1,K2,P1,P2]|FILE",
        "The camera, in pixels of the source (first pixel's centre at 0.5, 0.5). Default: the data set's, EXIF, else "
        "self-calibrated.",
    ),
    "camera": (
        "frames.camera", "auto|perspective|equirectangular|fisheye",
        "Kind of camera: equirectangular for whole 360° panoramas, fisheye for a lens given by --intrinsics (k1 to k4 "
        "of OpenCV's fisheye). Default: auto, from the source's metadata.",
    ),
    "poses": (
        "frames.poses", "FILE|FOLDER",
        "Camera poses by another program to start from: a COLMAP model, a transforms.json, ARKit's JSON, a TUM "
        "trajectory or lines of 4x4 matrices. They need not be exact, nor all there.",
    ),
    "masks": (
        "frames.masks", "FOLDER",
        "Folder of masks: NAME.png for an image NAME, or the frame's number for a video. Black pixels are ignored.",
    ),
    "scale-ref": (
        "proxy.scale_ref", "REF",
        "Metres without metric depth: IMAGE:X1,Y1,X2,Y2=METRES, two pixels of one image, height=METRES, "
        "or poses: those of --poses are in metres.",
    ),
    "scale": (
        "export.scale", "auto|free",
        "auto: estimate metres per unit where neither metric depth nor --scale-ref gives them; free: do not. Neither "
        "rescales coordinates. Default: auto.",
    ),
    "gps": (
        "export.gps", "FILE",
        "Where it was taken, for files with x east, y north in metres: a GPX track, or a CSV with the columns time, "
        "lat, lon, alt (a video counts from its start). Default: auto, the images' EXIF; off for neither.",
    ),
}  # fmt: skip
"""Option → its setting, metavar, help."""


def source_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that describe the source of a reconstruction; see `source_settings`."""
    for name, (setting, metavar, help) in reversed(_SOURCE_OPTIONS.items()):
        command = click.option(f"--{name}", setting.replace(".", "__"), metavar=metavar, help=help)(command)
    return command


def device_option(command: Callable[..., None]) -> Callable[..., None]:
    """--device of `source_options` alone; see `source_settings`."""
    setting, metavar, help = _SOURCE_OPTIONS["device"]
    return click.option("--device", setting.replace(".", "__"), metavar=metavar, help=help)(command)


def source_settings(given: dict[str, str | None]) -> list[str]:
    """The options of `source_options` as `section.key="value"` texts.

    Raises SettingError, in the words that were typed, for a value that one cannot have.
    """
    from msgs_slam.formats.errors import SettingError
    from msgs_slam.pipelines.read_config import load_config

    texts = []
    for option, (key, *_) in _SOURCE_OPTIONS.items():
        if (value := given.get(key.replace(".", "__"))) is None:
            continue
        text = f"{key}={_toml_string(value)}"
        try:
            load_config(None, [text])
        except SettingError as error:
            raise SettingError(str(error).replace(f"--set {text}: {key}", f"--{option}")) from error
        texts.append(text)
    return texts


def _toml_string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def set_up_logging(quiet: bool, verbose: bool, as_json: bool | None = None) -> None:
    """Logs go to stderr: warnings, or everything, or errors only; as the command line asks, or `as_json`."""
    if quiet and verbose:
        raise click.UsageError("-q and -v exclude each other")
    level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
    as_json = _as_json() if as_json is None else as_json
    handler: logging.Handler = JsonHandler() if as_json else TextHandler()
    handler.addFilter(SaidOnce())
    logging.basicConfig(level=level, handlers=[handler], force=True)


_said: set[str] = set()
"""The warnings shown since logging was set up."""


class SaidOnce(logging.Filter):
    """Shows a warning once, however often it comes."""

    def __init__(self) -> None:
        super().__init__()
        _said.clear()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is news."""
        text = record.getMessage()
        is_news = record.levelno != logging.WARNING or text not in _said
        if record.levelno == logging.WARNING:
            _said.add(text)
        return is_news


def is_said(warning: str) -> bool:
    """Whether it has been shown already."""
    return warning in _said


def make_progress(quiet: bool, as_json: bool | None = None) -> Progress:
    """Bars on a terminal, a line a stage in a file or pipe, JSON lines, or nothing."""
    from msgs_slam.msgs_cli.progress import BarProgress
    from msgs_slam.pipelines.system.progress import LineProgress, SilentProgress

    if quiet:
        return SilentProgress()
    as_json = _as_json() if as_json is None else as_json
    if as_json:
        return JsonProgress()
    return BarProgress() if sys.stderr.isatty() else LineProgress()


def tell_result(quiet: bool, **paths: Path | list[Path] | bool) -> None:
    """The last event of a command that went well, for programs: where its results are."""
    if _as_json() and not quiet:
        texts = {k: [str(p) for p in v] if isinstance(v, list) else str(v) for k, v in paths.items()}
        write_line("result", **texts, exit_code=0)


def worker_setup(quiet: bool, verbose: bool, remote: bool) -> Callable[[str], Progress]:
    """Return a picklable function that sets up logging in a process that works on one recording of many, and returns
    its progress: bars here, lines from elsewhere."""
    return partial(_worker_progress, quiet, verbose, _as_json(), remote)


def _worker_progress(quiet: bool, verbose: bool, as_json: bool, remote: bool, name: str) -> Progress:
    from msgs_slam.pipelines.system.progress import LineProgress

    set_up_logging(quiet, verbose, as_json)
    if remote and not quiet and not as_json:
        return LineProgress(name)
    logging.getLogger("msgs_slam").info("%s: begins", name)
    return make_progress(quiet, as_json)


def open_run(path: Path) -> RunFolder:
    """Raises InputError for a folder that is no run."""
    from msgs_slam.pipelines.reconstruct import require_run
    from msgs_slam.pipelines.run.folder import RunFolder

    run = RunFolder(path)
    require_run(run)
    return run


@contextmanager
def like_ctrl_c() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM (docker stop, systemd) inside this block."""
    from msgs_slam.pipelines.system.stopping import let_libraries_take_signals

    let_libraries_take_signals()
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def ending_quietly() -> Iterator[None]:
    """End the process on SIGTERM inside this block, at once and without a library's stack trace."""
    from msgs_slam.pipelines.system.stopping import let_libraries_take_signals

    let_libraries_take_signals()
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


_STOPPING = (
    "Stopping at the next snapshot. Press Ctrl-C again to stop now (what was done since the last snapshot is lost)."
)


@contextmanager
def stopping_softly(how_to_go_on: str) -> Iterator[None]:
    """The first SIGINT, SIGTERM or SIGHUP ends the work in this block at its next snapshot, the second at once; then
    the process ends with 128 plus the signal's number, as shells expect."""
    from msgs_slam.pipelines.system.stopping import soft_stop

    as_json = _as_json()

    def tell(number: int) -> None:
        if as_json:
            write_line("stopping", signal=number, message=_STOPPING)
        else:  # not through click: a signal may come while it prints
            os.write(2, f"\n{_STOPPING}\n".encode())

    try:
        with soft_stop(tell):
            yield
    except KeyboardInterrupt as error:
        number = getattr(error, "number", signal.SIGINT)
        if as_json:
            write_line("stopped", signal=int(number), message=how_to_go_on, exit_code=128 + number)
        else:
            say(f"\nStopped. {how_to_go_on}", err=True)
        sys.exit(128 + number)
