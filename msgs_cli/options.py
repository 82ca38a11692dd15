"""Options and small helpers that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..pipelines.run.names import STAGES

if TYPE_CHECKING:
    from ..pipelines.config import Config
    from ..pipelines.engine.placement import ClusterWorkers
    from ..pipelines.run.folder import RunFolder
    from .output import Output

FOLDER = click.Path(path_type=Path, file_okay=False)
RUN_ARGUMENT = click.argument("run_path", metavar="RUN", type=click.Path(path_type=Path))
UNTIL = click.option("--until", type=click.Choice(STAGES), default=STAGES[-1], help="Stop after this stage.")


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
def cluster_workers(name: str, address: str, config: Config, output: Output) -> Iterator[ClusterWorkers | None]:
    """The workers that take a run's tasks, None for this process; each with as many threads, or the results would
    differ."""
    require_engine(name, address)
    if name == "local":
        yield None
        return
    from ..pipelines.engine.placement import ClusterWorkers, RayCluster

    cluster = RayCluster(address)
    try:
        threads = config.run.threads or cluster.smallest_node
        gpus = int(config.run.device == "cuda")
        yield ClusterWorkers(cluster, threads, gpus, cluster.room(threads), output.options)
    finally:
        cluster.close()


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


def source_settings(given: Mapping[str, str | int | None]) -> list[str]:
    """The options of `source_options`, and --hold-out, as `section.key="value"` texts.

    Raises SettingError, in the words that were typed, for a value that one cannot have.
    """
    from ..formats.errors import SettingError
    from ..pipelines.read_config import load_config, toml_value

    texts = []
    for option, key in [*((name, row[0]) for name, row in _SOURCE_OPTIONS.items()), ("hold-out", "mapping.hold_out")]:
        if (value := given.get(key.replace(".", "__"))) is None:
            continue
        text = f"{key}={toml_value(value)}"
        try:
            load_config(None, [text])
        except SettingError as error:
            raise SettingError(str(error).replace(f"--set {text}: {key}", f"--{option}")) from error
        texts.append(text)
    return texts


def open_run(path: Path) -> RunFolder:
    """Raises InputError for a folder that is no run."""
    from ..pipelines.reconstruct import require_run
    from ..pipelines.run.folder import RunFolder

    run = RunFolder(path)
    require_run(run)
    return run
