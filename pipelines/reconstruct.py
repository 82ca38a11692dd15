"""The whole pipeline from a source to a finished run, for the commands `reconstruct`, `resume` and `status`; and
`batch`: a run for each of many recordings, one table, going on after failures.

A recording's run folder is all that is known of it, and its lock sees to it that one process at a time works on it. So
any number of batches over the same folders may be started, killed and started again, on one machine or many.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..formats.atomic import temporary_of, unique_temp_names, write_text
from ..formats.datasets import is_recording_folder
from ..formats.errors import InputError, RecoverableError
from ..formats.gps import read_track
from ..formats.images import VIDEO_SUFFIXES
from ..formats.reading import require_listable, require_unicode
from ..formats.textfile import write_json
from ..formats.video import probe_video
from .config import GPS_AUTO, GPS_OFF, SOURCE_LIST, STAGES, Config
from .frames.inputs import check_frames, frames_division
from .proxy.selection import check_proxy, choose_providers
from .run.files import CALIBRATION, TRAJECTORY
from .run.folder import RunFolder
from .run.lock import LOCK, SOFT_LOCK, RunBusyError, locked, make_folder
from .run.manifest import Source, keyframe_psnr, recorded_config
from .run.progress import ProgressFile
from .run.reads import StageRecord
from .run.runner import run_stages
from .run.settings import with_absolute_paths
from .run.stages import LazyFunction, Stage, StageContext, TaskWorkers
from .source.files import require_different
from .source.recording import open_recording
from .system.machine import available_cpus, require_device, submap_count, submap_size
from .system.progress import Progress, log
from .system.wording import markdown_table, quoted

if TYPE_CHECKING:
    from .run.cluster import RayCluster

_MAX_NAMED = 5
_HIDDEN_PREFIXES = (".", "__MACOSX")
"""Beginnings of names: hidden files, and what macOS adds to an archive."""
DONE, FAILED, ELSEWHERE, UNFINISHED, NOT_YET = "done", "failed", "in another process", "unfinished", "not yet"
_FIGURES = (("frames", "frames"), ("tracking", "posed"), ("tracking", "keyframes"))


def all_stages(method: str = "default") -> list[Stage]:
    """The stages of a method (`run.method`) in order. Nothing that computes is imported before a stage runs."""
    between = [
        Stage("tracking", LazyFunction("tracking.stage")),
        Stage("mapping", LazyFunction("mapping.stage"), division=_mapping_division),
        Stage("global_ba", LazyFunction("global_ba.stage")),
    ]
    if method == "paper":
        names = {"tracking": "track_by_map", "mapping": "map_keyframes", "global_ba": "close_and_adjust"}
        between = [Stage(stage, LazyFunction("paper.stages", name)) for stage, name in names.items()]
    return [
        Stage("frames", LazyFunction("frames.stage"), check_frames, frames_division),
        Stage("proxy", LazyFunction("proxy.stage"), check_proxy, check_settings=choose_providers),
        *between,
        Stage("export", LazyFunction("export.stage"), _check_export),
    ]


def _mapping_division(run: RunFolder, config: Config) -> int:
    """The number of submaps: more for less memory."""
    kept, _ = run.load(TRAJECTORY, "tracking").split(config.mapping.hold_out)
    return submap_count(len(kept), submap_size(config, run.load(CALIBRATION).intrinsics))


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
            f"{run.root} is the run of another source ({run.source.path}), not of these videos. "
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
    begun = run.manifest_file.exists() and (run.settings_file.exists() or run.records)
    return run.settings() if begun else None


def made_with(run: RunFolder) -> Config:
    """The settings that each finished stage was made with; of the others those of run.toml."""
    return recorded_config(run.records, run.settings())


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
        raise InputError(f"{source} is a run, not a source: `msgs-slam resume {quoted(source)}` continues it")
    require_unicode(source.resolve())  # the manifest names it
    require_unicode(run.root.absolute())
    config = with_absolute_paths(config)
    _require_run_or_empty(run)
    digest = open_recording(source, config.run.format).digest
    require_device(config.run.device)  # refused before anything is written
    with locked(run):
        _require_same_source(run, source, digest, config.run.format)
        return _run(run, Source(str(source.resolve()), digest), config, progress, until, workers, threads)


def resume(
    run: RunFolder,
    progress: Progress,
    config: Config | None = None,
    until: str = STAGES[-1],
    workers: TaskWorkers | None = None,
    redo: str = "",
) -> dict[str, StageRecord]:
    """Go on with a run from its own settings, or from `config`; the stage `redo` and those after it are made again."""
    run.required()
    if run.is_piece:
        raise InputError(
            f"{run.root} is a piece of {run.place.parent}: run `msgs-slam resume {quoted(run.place.parent)}`"
        )
    origin = run.source
    config = with_absolute_paths(config or run.settings())
    require_device(config.run.device)
    with locked(run):
        return _run(run, origin, config, progress, until, workers, redo=redo)


def extend(run: RunFolder, videos: Sequence[Path], progress: Progress) -> dict[str, StageRecord]:
    """Add videos by the same camera to a finished run: see `docs/adding.md`. Stopped once it has begun, the same
    call or `resume` goes on.

    Raises InputError, with nothing changed, for a run that is not finished or not of plain videos, and for a video of
    another size.
    """
    run.required()
    from .source.extending import add_videos, is_added, require_extendable

    if run.is_piece or is_added(run, videos):
        return resume(run, progress)
    with locked(run):
        config = run.settings()
        require_device(config.run.device)
        require_extendable(run, videos, config)
        return _run(run, add_videos(run, videos, config), config, progress)


def _run(
    run: RunFolder,
    origin: Source,
    config: Config,
    progress: Progress,
    until: str = STAGES[-1],
    workers: TaskWorkers | None = None,
    threads: int = 0,
    redo: str = "",
) -> dict[str, StageRecord]:
    source, digest = Path(origin.path), origin.digest

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
        work = StageContext(run, source, config, run.root, noted, [], stages, same_source, workers)
        return run_stages(work, digest, until, threads, redo)


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
        f"made: continue with --set run.format={was}, or make another run with --out NEW"
    )


def _require_same_source(run: RunFolder, source: Path, digest: str, format: str) -> None:
    if not run.manifest_file.exists():
        return
    origin = run.source
    if origin.digest != digest:
        _require_format(run, source, origin.digest, format)
        raise InputError(
            f"{run.root} is the run of another source ({origin.path}), not of {source}. "
            "Choose another folder with --out FOLDER, or delete it"
        )


# many recordings -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BatchItem:
    """A source and the folder of its run."""

    name: str
    source: Path
    run: Path

    @property
    def failure_file(self) -> Path:
        """Why it failed the last time; not there where it did not."""
        return self.run.with_suffix(".failed.txt")


def find_recordings(folder: Path, runs: Path) -> list[BatchItem]:
    """The videos, image folders and data sets directly in a folder, by name, damaged ones too: each says itself why it
    fails. Other folders are reported. Raises InputError where there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder. `batch` takes a folder of videos, image folders or data sets")
    visible = [p for p in sorted(folder.iterdir()) if not p.name.startswith(_HIDDEN_PREFIXES) and not _is_run(p, runs)]
    sources = [p for p in visible if _is_recording(p)]
    others = [p.name for p in visible if p not in sources and p.is_dir() and any(p.iterdir())]
    if others:
        log.warning(
            "left out, no images and no data set directly in them: %s (%d in all). Give each such folder to `batch` "
            "itself, or move what it holds up",
            ", ".join(others[:_MAX_NAMED]), len(others),
        )  # fmt: skip
    if not sources:
        raise InputError(f"{folder} holds no video, image folder or data set")
    stems = [p.stem if p.is_file() else p.name for p in sources]
    files = {p.name.casefold() for p in sources if p.is_file()}
    alike = Counter(map(str.casefold, stems))  # one folder on disks that do not tell cases apart (NTFS, APFS)
    clear = [alike[s] == 1 and s not in files for s in map(str.casefold, stems)]
    names = [stem if is_clear else p.name for stem, is_clear, p in zip(stems, clear, sources, strict=True)]
    return [BatchItem(n, p, runs / f"{n}.msgs") for n, p in zip(names, sources, strict=True)]


def _is_run(path: Path, runs: Path) -> bool:
    return path.suffix == ".msgs" or path.resolve() == runs.resolve() or RunFolder(path).manifest_file.exists()


def _is_recording(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in VIDEO_SUFFIXES
    try:
        return path.is_dir() and is_recording_folder(path)
    except InputError:  # it may not be read, which its own attempt reports
        return True


@dataclass(frozen=True)
class Job:
    """A recording with its settings, the last stage, the CPU threads where the settings leave them open (0: all), and
    what sets logging up for a named recording, in the process that works on it, and returns its progress."""

    recording: BatchItem
    config: Config
    until: str
    threads: int
    progress_of: Callable[[str], Progress]


def run_batch(
    recordings: Sequence[BatchItem],
    read: Callable[[Config | None], Config],
    until: str,
    progress_of: Callable[[str], Progress],
    cluster: RayCluster | None = None,
) -> list[BatchItem]:
    """Bring the runs of these recordings up to date, each in a process of its own; what another process works on is
    left to it.

    Args:
        recordings: with the folders of their runs.
        read: lays the settings asked for over those that a run has already, if any.
        until: the last stage.
        progress_of: sets logging up for a named recording and returns its progress; pickled.
        cluster: where they are reconstructed; None for this machine, one after the other.

    Returns:
        The recordings that failed.
    """
    jobs = []
    for recording in recordings:
        try:
            config = with_absolute_paths(read(existing_config(RunFolder(recording.run))))
            jobs.append(Job(recording, config, until, cluster.threads if cluster else 0, progress_of))
        except InputError as error:
            _write_failure(recording, str(error))
    folders = list(dict.fromkeys(folder for r in recordings for folder in (r.source.parent, r.run.parent)))
    from .run.cluster import run_in_processes

    ended = run_in_processes(_run_job, jobs) if cluster is None else cluster.run(_run_job, jobs, folders)
    for number, result in ended:
        recording = jobs[number].recording
        try:
            result()
        except Exception as error:  # of its process: what the recording itself raises is written down there
            _write_failure(recording, str(error))
        if recording.failure_file.exists():
            log.error("%s: %s", recording.name, _last_line(recording.failure_file))
    return [r for r in recordings if r.failure_file.exists()]


def _run_job(job: Job, _: Progress) -> None:
    log.info("%s: %s", name := job.recording.name, reconstruct_one(job, job.progress_of(name)))


def reconstruct_one(job: Job, progress: Progress) -> str:
    """Reconstruct one recording in this process; it may be done twice, at any time, by any process. Returns DONE,
    FAILED with the reason beside the run, or ELSEWHERE."""
    recording = job.recording
    recording.failure_file.unlink(missing_ok=True)
    try:
        run = RunFolder(recording.run)
        reconstruct(recording.source, run, job.config, progress, job.until, threads=job.threads)
    except RunBusyError:
        return ELSEWHERE
    except Exception as error:
        _write_failure(recording, str(error) if isinstance(error, InputError) else traceback.format_exc())
        return FAILED
    return DONE


def _write_failure(recording: BatchItem, reason: str) -> None:
    with unique_temp_names():  # a shard that is started twice may fail twice at the same moment
        write_text(recording.failure_file, reason.rstrip() + "\n")


def table_row(recording: BatchItem) -> dict[str, Any]:
    """One row of the table, from the files of the run folder: whichever process worked on it, and whenever."""
    row: dict[str, Any] = {"recording": recording.name, "state": NOT_YET}
    run = RunFolder(recording.run)
    try:
        records = run.records
    except InputError as error:
        return {**row, "state": FAILED, "error": str(error).splitlines()[0]}
    if run.root.exists():
        row["state"] = DONE if STAGES[-1] in records else f"{UNFINISHED} ({', '.join(records) or 'nothing done'})"
    for stage, name in _FIGURES:
        if stage in records:
            row[name] = records[stage].figures.get(name)
    if records:
        row["keyframe_psnr"] = keyframe_psnr(records)
        row["seconds"] = round(sum(r.seconds for r in records.values()), 1)
        row["peak_mb"] = round(max(r.peak_memory_mb for r in records.values()))
        row["warnings"] = sum(len(r.warnings) for r in records.values())
    if recording.failure_file.exists():
        row |= {"state": FAILED, "error": _last_line(recording.failure_file)}
    return row


def _last_line(file: Path) -> str:
    """A traceback says last what it was; a message says all in its first line."""
    lines = file.read_text(encoding="utf-8", errors="replace").strip().splitlines() or [""]
    return lines[-1 if any(line.startswith("Traceback") for line in lines) else 0]


def write_table(runs: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """batch.json and batch.md beside the runs."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = markdown_table(columns, ([str(row.get(c, "")) for c in columns] for row in rows))
    with unique_temp_names():  # all shards write them, often at the same moment
        write_json(runs / "batch.json", list(rows))
        write_text(runs / "batch.md", "\n".join(lines) + "\n")
