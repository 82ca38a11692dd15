"""The lead of a run on a disk without locks: a file that only one process can make, and signs that it is alive."""

from __future__ import annotations

import _thread
import json
import os
import platform
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ...formats.atomic import machine_mark, process_mark
from ..system.progress import log

BEAT, SILENT = 15.0, 180.0
"""Seconds between two signs of life, and without one after which a process is taken for dead: network disks show a
file's time up to a minute late."""


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
    about = {"host": platform.node(), "mark": machine_mark(), "process": os.getpid(), "since": time.time_ns()}
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
    aside = path.with_name(f"{path.name}-{process_mark()}")
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
        if about["mark"] == machine_mark():
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
