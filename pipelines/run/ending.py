"""The end of a stage, in steps of which each may be the last one before a kill:

    1. its record, with the checksums of all results, is written into the unfinished folder: from here on it is finished
    2. snapshot and notes of what was read are removed
    3. the folder of an earlier result is renamed aside and removed; what others put there goes to exports/
    4. the unfinished folder takes the name of the stage
    5. the manifest names the stage
    6. the record in the folder is removed

A later process that finds such a record takes the stage over if every file is as the record says.
"""

import glob
import os
import shutil
import time
from contextlib import suppress
from dataclasses import asdict
from itertools import count
from pathlib import Path

from ...formats.errors import InputError, RecoverableError
from ...formats.reading import file_sha256, parsing
from ...formats.textfile import MAX_OWN_JSON_BYTES, read_json_object, write_json
from ..config import STAGES
from ..system.progress import log
from ..system.values import dataclass_from_json
from ..system.wording import quoted
from .folder import RunFolder
from .manifest import content_digest
from .reads import LOGS, Situation, StageRecord
from .target import LIST

SNAPSHOT, RECORD = "snapshot", ".record.json"
"""In an unfinished folder: the folder of snapshots, the record of a stage that ended."""


def results(folder: Path) -> dict[str, tuple[int, str]]:
    """Relative path → (bytes, sha256) of every result in a stage's folder, finished or not."""
    return checksums(folder, but=(LOGS, SNAPSHOT, RECORD, LIST))


def checksums(folder: Path, but: tuple[str, ...] = ()) -> dict[str, tuple[int, str]]:
    """Relative path, with slashes, → (bytes, sha256) of every file below, but for the entries `but` of the folder."""
    files = {p.relative_to(folder): p for p in sorted(folder.rglob("*")) if p.is_file() and not p.is_symlink()}
    return {n.as_posix(): (p.stat().st_size, file_sha256(p)) for n, p in files.items() if n.parts[0] not in but}


def seal(folder: Path, record: StageRecord) -> None:
    """Declare an unfinished folder finished. Raises InputError when the disk refuses."""
    write_json(folder / RECORD, asdict(record))


def find_sealed(run: RunFolder, name: str, now: Situation) -> StageRecord | None:
    """Find the record of a stage that ended without entering the manifest; None where there is none of this very work,
    or a file is not as it says."""
    for folder in (run.partial(name), run.stage(name)):
        with suppress(InputError), parsing(folder / RECORD, "record of a stage"):
            record = dataclass_from_json(StageRecord, read_json_object(folder / RECORD, MAX_OWN_JSON_BYTES))
            if record.reads.difference(now) or content_digest(record.files) != record.content:
                continue
            found = results(folder)
            if all(found.get(file) == expected for file, expected in record.files.items()):
                return record
    return None


def move_in(run: RunFolder, name: str) -> None:
    """Give a sealed folder the name of its stage, in the place of an earlier result, unless that is done."""
    folder, target = run.partial(name), run.stage(name)
    if not (folder / RECORD).exists():
        return
    shutil.rmtree(folder / SNAPSHOT, ignore_errors=True)
    shutil.rmtree(folder / LOGS, ignore_errors=True)
    if name == STAGES[-1]:
        _spare_others(run, folder)
    try:
        discard(target)
        os.replace(folder, target)
    except PermissionError as error:
        raise RecoverableError(
            f"{target} cannot be replaced ({error.strerror}): on Windows, close the programs that have a file in it "
            f"open; elsewhere, check its rights. Then run `msgs-slam resume {quoted(run.root)}`"
        ) from error
    _flush_folder(run.root)


def _spare_others(run: RunFolder, new: Path) -> None:
    """Move what no stage has left in the export's folder into exports/, which no stage touches."""
    old, manifest = run.stage(STAGES[-1]), run.manifest()
    records = {**manifest.stale, **manifest.records} if manifest else {}
    known = set(records[STAGES[-1]].files) if STAGES[-1] in records else set()
    tops = {entry.name for entry in new.iterdir()} if not known else set()
    others = {n for n in checksums(old) if n not in known and n.partition("/")[0] not in {*tops, LIST, RECORD}}
    if others:
        kept = next(path for k in count(1) if not (path := run.path("exports", f"kept_{k}")).exists())
        for name in others:
            (kept / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(old / name, kept / name)
        log.warning("%d files in %s are not of the run: they are in %s now", len(others), old, kept)


def unseal(run: RunFolder, name: str) -> None:
    """Remove the record from the folder of a stage that the manifest names."""
    with suppress(OSError):
        run.path(name, RECORD).unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    """Make a rename survive a power cut. Windows opens no folders, and NTFS keeps a journal."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    os.fsync(descriptor)
    os.close(descriptor)


def discard(folder: Path) -> None:
    """Remove a folder whose name is needed. It is renamed first: what other processes have open in it may stay on a
    network disk for as long as they do, in a folder beside it that the next call removes."""
    with suppress(FileNotFoundError):
        folder.rename(folder.with_name(f".{folder.name}.old-{time.time_ns()}"))
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.old-*"):
        shutil.rmtree(old, ignore_errors=True)


def empty(folder: Path) -> None:
    """Make the folder, with nothing in it."""
    discard(folder)
    folder.mkdir(parents=True)
