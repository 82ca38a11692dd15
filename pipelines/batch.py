"""Many recordings: a run each, one table, going on after failures.

A recording's run folder is all that is known of it, and its lock sees to it that one process at a time works on it. So
any number of batches over the same folders may be started, killed and started again, on one machine or many.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from ..formats.atomic import unique_temp_names, write_text
from ..formats.datasets import is_recording_folder
from ..formats.errors import InputError, RecoverableError
from ..formats.images import VIDEO_SUFFIXES
from ..formats.textfile import write_json
from .config import STAGES, Config
from .read_config import with_absolute_paths
from .reconstruct import existing_config, reconstruct
from .run.folder import RunFolder, load_records
from .run.lock import RunBusyError
from .run.manifest import keyframe_psnr
from .system.progress import Progress, SilentProgress, Stopped, is_asked, log, soft_stop, stop_if_asked
from .system.wording import markdown_table

if TYPE_CHECKING:
    from .run.cluster import RayCluster

T = TypeVar("T")
_TRIES = 2
"""How often the process of a recording is started when it is lost."""
_MAX_NAMED = 5
_HIDDEN_PREFIXES = (".", "__MACOSX")
"""Beginnings of names: hidden files, and what macOS adds to an archive."""
DONE, FAILED, ELSEWHERE, UNFINISHED, NOT_YET = "done", "failed", "in another process", "unfinished", "not yet"
_FIGURES = (("frames", "frames"), ("tracking", "posed"), ("tracking", "keyframes"))


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
    files = {p.name for p in sources if p.is_file()}
    clear = [stems.count(stem) == 1 and stem not in files for stem in stems]
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
    what sets logging up in the process that works on it."""

    recording: BatchItem
    config: Config
    until: str
    threads: int
    output: JobOutput


class JobOutput(Protocol):
    """Sets logging up for a named recording and returns its progress; pickled with the job."""

    def task_progress(self, name: str) -> Progress:
        """Set up and return the progress."""
        ...


def run_batch(
    recordings: Sequence[BatchItem],
    read: Callable[[Config | None], Config],
    until: str,
    output: JobOutput,
    cluster: RayCluster | None = None,
) -> list[BatchItem]:
    """Bring the runs of these recordings up to date, each in a process of its own; what another process works on is
    left to it.

    Args:
        recordings: with the folders of their runs.
        read: lays the settings asked for over those that a run has already, if any.
        until: the last stage.
        output: shows how far each is.
        cluster: where they are reconstructed; None for this machine, one after the other.

    Returns:
        The recordings that failed.
    """
    jobs = []
    for recording in recordings:
        try:
            config = with_absolute_paths(read(existing_config(RunFolder(recording.run))))
            jobs.append(Job(recording, config, until, cluster.threads if cluster else 0, output))
        except InputError as error:
            _write_failure(recording, str(error))
    folders = list(dict.fromkeys(folder for r in recordings for folder in (r.source.parent, r.run.parent)))
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
    progress = job.output.task_progress(job.recording.name)
    log.info("%s: %s", job.recording.name, reconstruct_one(job, progress))


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
    except InputError as error:
        _write_failure(recording, str(error))
        return FAILED
    except Exception:
        _write_failure(recording, traceback.format_exc())
        return FAILED
    return DONE


def run_in_processes(
    work: Callable[[T, Progress], object], tasks: Sequence[T]
) -> Iterator[tuple[int, Callable[[], None]]]:
    """Call `work`, a function of a module's top level, on each task in a process of its own, one after the other.

    Yields the number of each task as its process ends, and what raises RecoverableError where that was lost twice
    (killed, out of memory). The first signal to stop is passed on to the process; one whose parent is gone stops.
    """
    for number, task in enumerate(tasks):
        for _ in range(_TRIES):
            stop_if_asked()
            code = _run_process(work, task)
            stop_if_asked()
            if code >= 0:
                break
            log.warning("task %d: its process was lost (%s)", number + 1, signal.Signals(-code).name)
        yield number, partial(_require_ended, code)


def _require_ended(code: int) -> None:
    if code:
        memory = ", for want of memory perhaps" if code == -signal.SIGKILL else ""
        how = f"ended by {signal.Signals(-code).name}{memory}" if code < 0 else f"exit code {code}"
        raise RecoverableError(f"its process was lost: {how}")


def _run_process(work: Callable[[T, Progress], object], task: T) -> int:
    """The exit code of the process, negative where a signal ended it."""
    process = multiprocessing.get_context("spawn").Process(target=_in_child, args=(work, task), daemon=True)
    process.start()
    is_passed_on = False
    try:
        while process.exitcode is None:
            process.join(0.2)
            if is_asked() and not is_passed_on:
                process.terminate()
                is_passed_on = True
        return process.exitcode
    finally:
        process.kill()
        process.join()


def _in_child(work: Callable[[T, Progress], object], task: T) -> None:
    os.setsid()  # a terminal's Ctrl-C goes to all processes of a session, and the parent passes on what it means
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    try:
        with soft_stop(lambda number: None):
            work(task, SilentProgress())
    except Stopped as stopped:
        sys.exit(128 + stopped.number)


def _stop_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _write_failure(recording: BatchItem, reason: str) -> None:
    with unique_temp_names():  # a shard that is started twice may fail twice at the same moment
        write_text(recording.failure_file, reason.rstrip() + "\n")


def table_row(recording: BatchItem) -> dict[str, Any]:
    """One row of the table, from the files of the run folder: whichever process worked on it, and whenever."""
    row: dict[str, Any] = {"recording": recording.name, "state": NOT_YET}
    run = RunFolder(recording.run)
    try:
        records = load_records(run)
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
