"""Many recordings: a run each, one table, going on after failures; shared between as many processes as one likes.

A recording's run folder is all that is known of it, and its lock sees to it that one process at a time works on it. So
any number of batches over the same folders may be started, killed and started again, on one machine or many.
"""

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..formats.atomic import unique_temp_names, write_text
from ..formats.datasets import looks_like_recording
from ..formats.errors import InputError
from ..formats.images import VIDEO_SUFFIXES
from ..formats.textfile import write_json
from .config import STAGES, Config
from .engine.placement import Command, Placement
from .reconstruct import existing_config, reconstruct
from .run.folder import RunFolder, load_records
from .run.lock import RunBusyError
from .run.manifest import keyframe_psnr
from .system.progress import Progress, log
from .system.wording import markdown_table

_MAX_NAMED = 5
_NOT_LISTED = (".", "__MACOSX")
"""How names begin that nobody gave: hidden files, and what macOS adds to an archive."""
DONE, FAILED, ELSEWHERE, UNFINISHED, NOT_YET = "done", "failed", "in another process", "unfinished", "not yet"
_FIGURES = (("frames", "frames"), ("tracking", "posed"), ("tracking", "keyframes"))


@dataclass(frozen=True)
class Recording:
    """A source and the folder of its run."""

    name: str
    source: Path
    run: Path

    @property
    def failure_file(self) -> Path:
        """Why it failed the last time; not there where it did not."""
        return self.run.with_suffix(".failed.txt")


def find_recordings(folder: Path, runs: Path) -> list[Recording]:
    """The videos, image folders and data sets directly in a folder, by name, damaged ones too: each says itself why it
    fails. Other folders are reported. Raises InputError where there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder. `batch` takes a folder of videos, image folders or data sets")
    visible = [p for p in sorted(folder.iterdir()) if not p.name.startswith(_NOT_LISTED) and not _is_run(p, runs)]
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
    return [Recording(n, p, runs / f"{n}.msgs") for n, p in zip(names, sources, strict=True)]


def _is_run(path: Path, runs: Path) -> bool:
    return path.suffix == ".msgs" or path.resolve() == runs.resolve() or RunFolder(path).manifest_file.exists()


def _is_recording(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in VIDEO_SUFFIXES
    try:
        return path.is_dir() and looks_like_recording(path)
    except InputError:  # it may not be read, which its own attempt reports
        return True


def run_batch(
    recordings: Sequence[Recording], placement: Placement, options: Sequence[str], cpus: int = 1, gpus: int = 0
) -> list[Recording]:
    """Bring the runs of these recordings up to date, each by a process of its own; what another process works on is
    left to it.

    Args:
        recordings: with the folders of their runs.
        placement: where the processes run.
        options: of the command `batch`, for each of them.
        cpus: CPUs that each takes of a node.
        gpus: GPUs that each takes of a node.

    Returns:
        The recordings that failed.
    """
    by_name = {r.name: r for r in recordings}
    commands = [
        Command(
            r.name,
            (
                "msgs_slam",
                "batch",
                str(r.source.parent),
                "--out",
                str(r.run.parent),
                "--placed",
                r.name,
                str(r.source),
                *options,
            ),
            cpus,
            gpus,
            (r.source, r.run.parent),
        )
        for r in recordings
    ]
    failed = []
    for result in placement.run(commands):
        if not result.failure:
            continue
        recording = by_name[result.command.name]
        if not (result.is_reported and recording.failure_file.exists()):
            _write_failure(recording, result.failure)
        log.error("%s: %s", recording.name, _last_line(recording.failure_file))
        failed.append(recording)
    return failed


def reconstruct_one(
    recording: Recording, read: Callable[[Config | None], Config], progress: Progress, until: str, threads: int = 0
) -> str:
    """Reconstruct one recording in this process; it may be done twice, at any time, by any process.

    Args:
        recording: its source, and the folder of its run.
        read: lays the settings asked for over those that the run has already, if any.
        progress: shows how far it is.
        until: the last stage.
        threads: CPU threads where the settings leave them open, 0 for all.

    Returns:
        DONE, FAILED with the reason beside the run, or ELSEWHERE.
    """
    try:
        run = RunFolder(recording.run)
        reconstruct(recording.source, run, read(existing_config(run)), progress, until, threads=threads)
    except RunBusyError:
        return ELSEWHERE
    except InputError as error:
        _write_failure(recording, str(error))
        return FAILED
    except Exception:
        _write_failure(recording, traceback.format_exc())
        return FAILED
    recording.failure_file.unlink(missing_ok=True)
    return DONE


def _write_failure(recording: Recording, reason: str) -> None:
    with unique_temp_names():  # a shard that is started twice may fail twice at the same moment
        write_text(recording.failure_file, reason.rstrip() + "\n")


def table_row(recording: Recording) -> dict[str, Any]:
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
