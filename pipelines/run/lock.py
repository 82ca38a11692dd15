"""One process at a time works on a run: it holds a lock or, on a disk without locks, a file that it keeps touching.
How far it is stands in a small file for other processes to read."""

from __future__ import annotations

import _thread
import fcntl
import json
import os
import platform
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, TypeVar

from ...formats.atomic import machine_token, process_token
from ...formats.errors import InputError, RecoverableError
from ...formats.reading import links_in, require_no_link
from ...formats.textfile import read_json
from ..config import STAGES
from ..system.progress import BEGUN, Progress, StageEvent, about, log
from .folder import RunFolder, load_records, load_stale, why_not_done
from .schema import dataclass_from_json

T = TypeVar("T")
LOCK, LEADER = ".lock", ".leader"
_LOOKS, _A_MOMENT = 3, 0.05
"""How often a lock that is held is tried again, and the seconds between."""
BEAT, SILENT = 15.0, 180.0
"""Seconds between two signs of life of the leader on a disk without locks, and without one after which it is taken for
dead: network disks show a file's time up to a minute late."""
PROGRESS = ".progress.json"
_BETWEEN_WRITES = 2.0
"""Seconds between two notes of progress."""


class RunBusyError(InputError):
    """Another process works on the run."""


@contextmanager
def locked(run: RunFolder) -> Iterator[None]:
    """Hold the run's lock, which the OS releases when the process ends, however it ends.
    On a disk without locks a file that only one process can make does the same (`leading`).

    The folder is made where it is missing, and removed again when the block ends with an error before the work began,
    or with an InputError, but for a RecoverableError, before a stage is done: what cannot be used leaves nothing
    behind. A folder that was there is never removed, nor one that another process holds. Raises InputError when
    another process does, or when the folder cannot be written.
    """
    made = make_folder(run.root)
    with _open(run.path(LOCK)) as stream, _alone(stream, run) as alone:
        if not alone or not _still_there(stream, run.path(LOCK)):
            raise RunBusyError(f"{run.root}: another msgs-slam process is working on this run. Wait for it to end")
        try:
            yield
        except Exception as error:
            unusable = isinstance(error, InputError) and not isinstance(error, RecoverableError)
            begun = run.manifest_file.exists()
            if made and (not begun or (unusable and not load_records(run))):
                shutil.rmtree(run.root, ignore_errors=True)
            raise


@contextmanager
def locked_export(run: RunFolder, folder: Path) -> Iterator[None]:
    """Hold the run's lock in this block where `folder`, which files are written to, is the run's own export: the stage
    would replace it meanwhile.

    Raises RunBusyError where another process works on the run, InputError where that export is of an earlier result of
    the stages before it, or holds links.
    """
    own = run.stage(STAGES[-1])
    if folder.resolve() != own.resolve():
        yield
        return
    elsewhere = "or write to another folder with --to DIR"
    with ExitStack() as held:
        try:
            held.enter_context(locked(RunFolder(run.place.parent) if run.is_piece else run))
        except RunBusyError as error:
            raise RunBusyError(f"{error}, {elsewhere}") from error
        if STAGES[-1] in load_stale(run):
            raise InputError(f"{why_not_done(run, STAGES[-1])}, {elsewhere}: other files would be mixed with these")
        if link := next(links_in(own), None):
            require_no_link(link)
        yield


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
def _alone(stream: IO[bytes], run: RunFolder) -> Iterator[bool]:
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
    with leading(run.path(LEADER)) as alone:
        yield alone


def is_led(run: RunFolder) -> bool:
    """Whether a process works on the run now, by its lock; where there are none, by the sign of life."""
    try:
        with _open_existing(run.path(LOCK)) as stream:
            taken = _take(stream)
    except OSError:  # nobody ever did, or it may not be read
        return False
    return shows_life(run.path(LEADER)) if taken is None else not taken


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
    """None where the disk has no locks."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a network disk without locks
        return None
    return True


def _still_there(stream: IO[bytes], path: Path) -> bool:
    """Whether the locked file is the folder's: the process before may have removed the folder in between."""
    try:
        return os.path.samestat(os.fstat(stream.fileno()), path.stat())
    except FileNotFoundError:
        return False


@contextmanager
def leading(path: Path) -> Iterator[bool]:
    """Make `path` for as long as the block takes; yields False where a process that is alive has made it before.

    The file says host and process; its time is changed every BEAT seconds. One whose process is gone, on this machine,
    or that has been silent for SILENT seconds, on any, is taken away. A process that finds the file to be another's,
    because it was suspended for that long, stops softly.
    """
    if not _made(path):
        yield False
        return
    mine, ended = path.read_bytes(), threading.Event()
    beats = threading.Thread(target=_beat, args=(path, mine, ended), daemon=True)
    beats.start()
    try:
        yield True
    finally:
        ended.set()
        beats.join()
        if _is(path, mine):
            path.unlink(missing_ok=True)


def shows_life(path: Path) -> bool:
    """Whether the file is there and has been given a sign of life, by this machine's clock."""
    try:
        return time.time() - path.stat().st_mtime < SILENT
    except FileNotFoundError:
        return False


def _made(path: Path) -> bool:
    about = {"host": platform.node(), "mark": machine_token(), "process": os.getpid(), "since": time.time_ns()}
    for _ in range(2):
        with suppress(FileExistsError), path.open("x", encoding="utf-8") as file:
            file.write(json.dumps(about))
            return True
        if not _taken_away(path):
            return False
    return False


def _taken_away(path: Path) -> bool:
    """Whether the file was that of a dead process, and is gone. Of several who try, one moves it aside; who has moved
    another one than he has judged gives it back."""
    aside = path.with_name(f"{path.name}-{process_token()}")
    try:
        judged = path.read_bytes()
        if _is_alive(path, judged, aside):
            return False
        path.rename(aside)
    except FileNotFoundError:
        return True
    same = _is(aside, judged)
    if not same:
        with suppress(OSError):
            os.link(aside, path)
    aside.unlink(missing_ok=True)
    return same


def _is_alive(path: Path, content: bytes, probe: Path) -> bool:
    """By the disk's own clock: those of two machines may differ."""
    probe.touch()
    age = probe.stat().st_mtime - path.stat().st_mtime
    probe.unlink()
    if age > SILENT:
        return False
    with suppress(ValueError, KeyError, TypeError, OverflowError):
        about = json.loads(content)
        if about["mark"] == machine_token():
            return _is_process(about["process"])
    return True


def _is_process(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def _is(path: Path, content: bytes) -> bool:
    try:
        return path.read_bytes() == content
    except OSError:
        return False


def _beat(path: Path, mine: bytes, ended: threading.Event) -> None:
    while not ended.wait(BEAT):
        if not _is(path, mine):
            log.error("%s: another process has taken this run over, for this one gave no sign of life: it stops", path)
            _thread.interrupt_main(signal.SIGINT)
            return
        with suppress(OSError):
            os.utime(path)


@dataclass(frozen=True)
class RunProgress:
    """The stage that is being made; of the piece of work that it is at how much is `done`, of how many (0: unknown);
    left: seconds to the end of all stages, 0 where nothing is known."""

    stage: str
    label: str = ""
    done: int = 0
    of: int = 0
    left: float = 0.0

    @property
    def text(self) -> str:
        """running, features 57 %, about 4 min left"""
        share = f", {self.label} {100 * self.done // self.of} %" if self.of else ""
        return f"running{share}" + (f", {about(self.left)} left" if self.left else "")


class ProgressFile:
    """Shows what another one shows, and notes it in the run while a stage is being made, seldom enough to cost nothing.
    The file goes with the block."""

    def __init__(self, progress: Progress, run: RunFolder) -> None:
        self._progress, self._file = progress, run.path(PROGRESS)
        self._event: StageEvent | None = None
        self._written = 0.0

    def __enter__(self) -> ProgressFile:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._file.unlink(missing_ok=True)

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items, and write how many are done to the file every so often."""
        of = total or (len(items) if isinstance(items, Sized) else 0)
        for done, item in enumerate(self._progress.track(items, label, total)):
            if time.monotonic() - self._written > _BETWEEN_WRITES:
                self._note(label, done, of)
            yield item

    def stage(self, event: StageEvent) -> None:
        """Attribute what is tracked from now on to this stage."""
        self._progress.stage(event)
        self._event = event if event.state == BEGUN else self._event
        if event.state == BEGUN:
            self._note()

    def _note(self, label: str = "", done: int = 0, of: int = 0) -> None:
        if self._event is None:
            return
        self._written = time.monotonic()
        now = RunProgress(self._event.name, label, done, of, float(self._event.left() or 0.0))
        temporary = self._file.with_suffix(".tmp")
        with suppress(OSError):  # who works must not stop for who watches
            temporary.unlink(missing_ok=True)  # never through a link that was there
            with temporary.open("x", encoding="utf-8") as file:
                file.write(json.dumps(asdict(now)))
            os.replace(temporary, self._file)


def load_run_progress(run: RunFolder) -> RunProgress | None:
    """Load the progress of the process at work; None where there is none, or no stage has started."""
    path = run.path(PROGRESS)
    if not path.exists() or not is_led(run):
        return None
    with suppress(InputError, ValueError):
        return dataclass_from_json(RunProgress, read_json(path))
    return None
