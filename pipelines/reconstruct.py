"""The whole pipeline from a source to a finished run, for the commands `reconstruct`, `resume` and `status`."""

from collections.abc import Sequence
from pathlib import Path

from ..formats.atomic import temporary_of, unique_temp_names, write_text
from ..formats.errors import InputError, RecoverableError
from ..formats.gps import read_track
from ..formats.reading import require_listable, require_unicode
from ..formats.video import probe_video
from .config import GPS_AUTO, GPS_OFF, SOURCE_LIST, STAGES, Config
from .frames.inputs import check_frames, frames_division
from .mapping.division import mapping_division
from .proxy.selection import check_proxy, choose_providers
from .read_config import with_absolute_paths
from .run.folder import RunFolder, load_records, load_settings, load_source
from .run.lock import LOCK, SOFT_LOCK, locked, make_folder
from .run.manifest import StageRecord, recorded_config
from .run.progress import ProgressFile
from .run.runner import run_stages
from .run.stages import Later, Stage, TaskWorkers
from .source.files import require_different
from .source.recording import open_recording
from .system.machine import available_cpus, require_device
from .system.progress import Progress
from .system.wording import quoted


def all_stages(method: str = "default") -> list[Stage]:
    """The stages of a method (`run.method`) in order. Nothing that computes is imported before a stage runs."""
    between = [
        Stage("tracking", Later("tracking.stage")),
        Stage("mapping", Later("mapping.stage"), division=mapping_division),
        Stage("global_ba", Later("global_ba.stage")),
    ]
    if method == "paper":
        names = {"tracking": "track_by_map", "mapping": "map_keyframes", "global_ba": "close_and_adjust"}
        between = [Stage(stage, Later("paper.stages", name)) for stage, name in names.items()]
    return [
        Stage("frames", Later("frames.stage"), check_frames, frames_division),
        Stage("proxy", Later("proxy.stage"), check_proxy, check_settings=choose_providers),
        *between,
        Stage("export", Later("export.stage"), _check_export),
    ]


def _check_export(source: Path, config: Config) -> None:
    """Raise InputError where the track that the user gives cannot be read."""
    if config.export.gps not in (GPS_AUTO, GPS_OFF):
        read_track(Path(config.export.gps))


def default_run_folder(source: Path) -> RunFolder:
    """`video.msgs` in the working folder for `…/video.mp4`."""
    name = source.resolve().stem if source.is_file() else source.resolve().name
    return RunFolder(Path(f"{name}.msgs"))


def one_source(sources: Sequence[Path], run: RunFolder) -> Path:
    """The source itself, or for several videos of one place a list of them, kept in the run folder.

    Raises InputError for what is no video and for a folder that holds something else, before anything is written.
    """
    if len(sources) == 1:
        return sources[0]
    require_different(sources)
    require_listable([*sources, run.root])
    _require_run_or_empty(run)
    path, text = run.path(SOURCE_LIST), "".join(f"{source.resolve()}\n" for source in sources)
    same = path.is_file() and path.read_bytes() == text.encode()
    if run.manifest_file.exists() and not same:
        raise InputError(
            f"{run.root} is the run of another source ({load_source(run).path}), not of these videos. "
            "Choose another folder with --out FOLDER, or delete it"
        )
    for source in sources:
        probe_video(source)
    if not same:
        make_folder(run.root)
        with unique_temp_names():  # no lock is held yet
            write_text(path, text)
    return path


def existing_config(run: RunFolder) -> Config | None:
    """The settings of run.toml, with which the run goes on, or None where there are none: no run, or one that was
    stopped before they were written."""
    begun = run.manifest_file.exists() and (run.settings_file.exists() or load_records(run))
    return load_settings(run) if begun else None


def made_with(run: RunFolder) -> Config:
    """The settings that each finished stage was made with; of the others those of run.toml."""
    return recorded_config(load_records(run), load_settings(run))


def reconstruct(
    source: Path,
    run: RunFolder,
    config: Config,
    progress: Progress,
    until: str = STAGES[-1],
    workers: TaskWorkers | None = None,
    threads: int = 0,
) -> dict[str, StageRecord]:
    """Make, or bring up to date, the run of `source`; with so many `threads` where the settings leave it open.

    What is open in the settings (`run.device=auto`, `run.threads=0`) is decided anew by every process that works on the
    run, and stays open in run.toml: the next one may be on another machine.

    Raises InputError for a source that cannot be used and for a folder that holds something else; a folder made by
    this call is removed again when the source turns out to be unusable.
    """
    if (made := RunFolder(source)).manifest_file.is_file() and made.settings_file.is_file():
        raise InputError(f"{source} is a run, no source: go on with it by `msgs-slam resume {quoted(source)}`")
    require_unicode(source.resolve())  # the manifest names it
    require_unicode(run.root.absolute())
    config = with_absolute_paths(config)
    _require_run_or_empty(run)
    digest = open_recording(source, config.run.format).digest
    require_device(config.run.device)  # refused before anything is written
    with locked(run):
        _require_same_source(run, source, digest, config.run.format)
        return _run(run, source.resolve(), digest, config, progress, until, workers, threads)


def resume(
    run: RunFolder,
    progress: Progress,
    config: Config | None = None,
    until: str = STAGES[-1],
    workers: TaskWorkers | None = None,
    redo: str = "",
) -> dict[str, StageRecord]:
    """Go on with a run from its own settings, or from `config`; the stage `redo` and those after it are made again."""
    require_run(run)
    if run.is_piece:
        raise InputError(
            f"{run.root} is a piece of {run.place.parent}: run `msgs-slam resume {quoted(run.place.parent)}`"
        )
    origin = load_source(run)
    source = Path(origin.path)
    config = with_absolute_paths(config or load_settings(run))
    require_device(config.run.device)
    with locked(run):
        return _run(run, source, origin.digest, config, progress, until, workers, redo=redo)


def extend(run: RunFolder, videos: Sequence[Path], progress: Progress) -> dict[str, StageRecord]:
    """Add videos by the same camera to a finished run: see `docs/adding.md`. Stopped once it has begun, the same
    call or `resume` goes on.

    Raises InputError, with nothing changed, for a run that is not finished or not of plain videos, and for a video of
    another size.
    """
    require_run(run)
    from .source.extending import add_videos, is_added, require_extendable

    if run.is_piece or is_added(run, videos):
        return resume(run, progress)
    with locked(run):
        config = load_settings(run)
        require_device(config.run.device)
        require_extendable(run, videos, config)
        source = add_videos(run, videos, config)
        return _run(run, Path(source.path), source.digest, config, progress, STAGES[-1], None)


def require_run(run: RunFolder) -> None:
    """Raise InputError unless the folder holds a run."""
    if run.manifest_file.exists():
        return
    what = "does not exist" if not run.root.exists() else "is not a run folder (it has no manifest.json)"
    near = f"; did you mean {' or '.join(map(str, found))}?" if (found := runs_near(run.root)) else "."
    raise InputError(f"{run.root} {what}{near} Runs are made by `msgs-slam reconstruct VIDEO`")


def runs_near(path: Path, limit: int = 3) -> list[Path]:
    """Run folders that may be meant where `path` is none: in it, around it, of the video that it is, of a like name."""
    inside = sorted(path.iterdir()) if path.is_dir() else []
    named = [path.with_suffix(".msgs"), Path(f"{path.stem}.msgs")] if path.name else []  # "." and "/" have no name
    places = [*named, *path.parents[:2]]
    found = dict.fromkeys(p for p in [*inside, *places] if RunFolder(p).manifest_file.is_file())
    return list(found)[:limit]


def _run(
    run: RunFolder,
    source: Path,
    digest: str,
    config: Config,
    progress: Progress,
    until: str,
    workers: TaskWorkers | None,
    threads: int = 0,
    redo: str = "",
) -> dict[str, StageRecord]:
    def same_source() -> None:
        kept = (
            f"What is done so far is kept: bring it back, then run `msgs-slam resume {quoted(run.root)}`; or, if it "
            f"lies elsewhere now: `msgs-slam reconstruct SOURCE --out {quoted(run.root)}`"
        )
        try:
            same = open_recording(source, config.run.format).digest == digest
        except InputError as error:
            _require_format(run, source, digest, config.run.format)
            raise RecoverableError(f"{error}. {kept}") from error
        if not same:
            _require_format(run, source, digest, config.run.format)
            raise RecoverableError(
                f"{source} has changed since {run.root} was made. {kept}. Or reconstruct what it is now into another "
                "folder: --out NEW"
            )

    threads = config.run.threads or (workers.threads if workers else threads) or available_cpus()
    with ProgressFile(progress, run) as noted:
        stages = all_stages(config.run.method)
        return run_stages(stages, run, source, digest, config, noted, until, same_source, workers, threads, redo)


def _require_run_or_empty(run: RunFolder) -> None:
    """Nothing is written, not even a lock, into a folder that holds something else."""
    if not run.root.is_dir() or run.manifest_file.exists():
        return
    # All that there is when the first file is being written.
    begun = {LOCK, SOFT_LOCK, SOURCE_LIST, temporary_of(run.manifest_file).name}
    # Other processes have names of their own for the list.
    others = temporary_of(run.path(SOURCE_LIST)).stem
    if any(p.name not in begun and not p.name.startswith(others) for p in run.root.iterdir()):
        raise InputError(f"{run.root} exists and is not a run folder. Choose another with --out FOLDER")


def _require_format(run: RunFolder, source: Path, digest: str, format: str) -> None:
    """Raise RecoverableError where the source is as it was and only read by another `run.format`."""
    was = made_with(run).run.format
    try:
        is_other = was != format and open_recording(source, was).digest == digest
    except InputError:  # which the caller reports
        return
    if not is_other:
        return
    raise RecoverableError(
        f"run.format={format} reads other images, times or cameras from {source} than {was}, with which {run.root} was "
        f"made: go on with --set run.format={was}, or make another run with --out NEW"
    )


def _require_same_source(run: RunFolder, source: Path, digest: str, format: str) -> None:
    if not run.manifest_file.exists():
        return
    origin = load_source(run)
    if origin.digest != digest:
        _require_format(run, source, origin.digest, format)
        raise InputError(
            f"{run.root} is the run of another source ({origin.path}), not of {source}. "
            "Choose another folder with --out FOLDER, or delete it"
        )
