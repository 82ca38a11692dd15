"""One process at a time works on a run."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ...formats.errors import InputError, RecoverableError
from .folder import RunFolder
from .lock_file import leading, shows_life
from .records import load_records

LOCK, LEADER = ".lock", ".leader"
_LOOKS, _A_MOMENT = 3, 0.05
"""How often a lock that is held is tried again, and the seconds between."""


class RunBusyError(InputError):
    """Another process works on the run."""


@contextmanager
def locked(run: RunFolder) -> Iterator[None]:
    """Hold the run's lock, which the OS releases when the process ends, however it ends. On a disk without locks a
    file that only one process can make does the same (`lock_file`).

    The folder is made where it is missing, and removed again when the block ends with an error before the work began,
    or with an InputError, but for a RecoverableError, before a stage is done: what cannot be used leaves nothing
    behind. A folder that was there is never removed, nor one that another process holds. Raises InputError when
    another process does, or when the folder cannot be written.
    """
    made = make_folder(run.root)
    with _open(run.root / LOCK) as stream, _alone(stream, run.root) as alone:
        if not alone or not _still_there(stream, run.root / LOCK):
            raise RunBusyError(f"{run.root}: another msgs-slam process is working on this run. Wait for it to end")
        try:
            yield
        except Exception as error:
            unusable = isinstance(error, InputError) and not isinstance(error, RecoverableError)
            begun = run.manifest_file.exists()
            if made and (not begun or (unusable and not load_records(run))):
                shutil.rmtree(run.root, ignore_errors=True)  # Windows keeps the open lock
            raise


def make_folder(root: Path) -> bool:
    """Make a run's folder; whether it was not there. Raises InputError where it cannot be made."""
    try:
        root.parent.mkdir(parents=True, exist_ok=True)
        root.mkdir()
    except FileExistsError:
        if not root.is_dir():
            raise InputError(f"{root} is a file; the run needs a folder. Choose another with --out FOLDER") from None
        return False
    except OSError as error:
        raise InputError(
            f"{root} cannot be made ({error.strerror}). Choose another folder with --out FOLDER"
        ) from error
    return True


def _open(path: Path) -> IO[bytes]:
    try:
        return path.open("ab")
    except OSError as error:
        raise InputError(
            f"{path.parent} cannot be written ({error.strerror}). Change its rights, or choose another folder"
        ) from error


@contextmanager
def _alone(stream: IO[bytes], root: Path) -> Iterator[bool]:
    """Whether no other process leads."""
    taken = _take(stream)
    for _ in range(_LOOKS):  # who only asks whether somebody leads holds it for a moment
        if taken is not False:
            break
        time.sleep(_A_MOMENT)
        taken = _take(stream)
    if taken is not None:
        yield taken
        return
    with leading(root / LEADER) as alone:
        yield alone


def is_led(run: RunFolder) -> bool:
    """Whether a process works on the run now, by its lock; where there are none, by the sign of life."""
    try:
        with _open_existing(run.root / LOCK) as stream:
            taken = _take(stream)
    except OSError:  # nobody ever did, or it may not be read
        return False
    return shows_life(run.root / LEADER) if taken is None else not taken


def _open_existing(path: Path) -> IO[bytes]:
    """Open for writing, without which NFS gives no lock of this kind; where that is not allowed, for reading."""
    try:
        return path.open("r+b")
    except OSError:
        return path.open("rb")


def take_lock(stream: IO[bytes]) -> bool:
    """Whether the lock of an open file could be had, or there are no locks here; it is held until the file is closed.
    For work that may be done twice."""
    return _take(stream) is not False


def _take(stream: IO[bytes]) -> bool | None:
    """None where the disk or the system has no locks."""
    try:
        import fcntl
    except ImportError:
        return _take_on_windows(stream)
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a network disk without locks
        return None
    return True


def _take_on_windows(stream: IO[bytes]) -> bool | None:
    try:
        import msvcrt
    except ImportError:
        return None
    stream.seek(0)
    try:
        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except OSError:
        return False
    return True


def _still_there(stream: IO[bytes], path: Path) -> bool:
    """Whether the locked file is the folder's: the process before may have removed the folder in between."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False
