"""One process at a time works on a run: it holds the lock of a file in it, which goes with the process."""

from __future__ import annotations

import errno
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout, lock_descriptor

from ...formats.errors import InputError, RecoverableError
from .folder import RunFolder

LOCK, SOFT_LOCK = ".lock", ".lock.owner"
"""The second on disks without locks: whichever process can make it works on the run."""
_WAITS = 0.2
"""Seconds: `is_locked` holds a lock for a moment."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


class RunBusyError(InputError):
    """Another process works on the run."""


@contextmanager
def locked(run: RunFolder) -> Iterator[None]:
    """Hold the run's lock, which the system releases when the process ends, however it ends. On a disk without locks a
    file that names the process does the same; one that a dead process of this machine has left is taken over.

    The folder is made where it is missing, and removed again when the block ends with an error before the work began,
    or with an InputError, but for a RecoverableError, before a stage is done: what cannot be used leaves nothing
    behind. A folder that was there is never removed, nor one that another process holds. Raises RunBusyError when
    another process does, InputError when the folder cannot be written.
    """
    made, spoiled = make_folder(run.root), False
    lock = _acquire(run)
    try:
        yield
    except Exception as error:
        unusable = isinstance(error, InputError) and not isinstance(error, RecoverableError)
        begun = run.manifest_file.exists()
        if spoiled := made and (not begun or (unusable and not run.records)):
            shutil.rmtree(run.root, ignore_errors=True)
        raise
    finally:
        lock.release()
        if spoiled:
            with suppress(OSError):  # Windows removes no file that is open, as the lock's was
                run.root.rmdir()


def _acquire(run: RunFolder) -> BaseFileLock:
    path, soft = run.path(LOCK), run.path(SOFT_LOCK)
    try:
        lock: BaseFileLock = FileLock(path, timeout=_WAITS, fallback_to_soft=False)
        lock.acquire()
        with suppress(OSError):
            path.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
    except Timeout as error:
        raise _busy(run, path) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise InputError(
                f"{run.root} cannot be written ({error.strerror}). Change its rights, or choose another folder"
            ) from error
        try:
            lock = SoftFileLock(soft, timeout=_WAITS)
            lock.acquire()
        except Timeout as busy:
            raise _busy(run, soft, f"; if it has been killed on another machine, delete {soft}") from busy
    return lock


def _busy(run: RunFolder, held: Path, more: str = "") -> RunBusyError:
    holder = ""
    with suppress(OSError):
        holder = " ".join(held.read_text(encoding="utf-8", errors="replace").split())
    return RunBusyError(
        f"{run.root}: another msgs-slam process is working on this run. Wait for it to end"
        f" (it is {holder or 'unknown'}){more}"
    )


def is_locked(run: RunFolder) -> bool:
    """Whether a process works on the run now, by its lock; where there are none, by the file of its owner."""
    try:
        with _open_existing(run.path(LOCK)) as stream:
            return not lock_descriptor(stream.fileno(), blocking=False)
    except OSError as error:
        return error.errno in _NO_LOCKS and run.path(SOFT_LOCK).exists()


def _open_existing(path: Path) -> IO[bytes]:
    """Open for writing, without which NFS gives no lock of this kind; where that is not allowed, for reading."""
    try:
        return path.open("r+b")
    except OSError:
        return path.open("rb")


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
            f"{root} cannot be created ({error.strerror}). Choose another folder with --out FOLDER"
        ) from error
    return True
