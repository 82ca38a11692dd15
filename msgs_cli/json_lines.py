"""Events of a run as one JSON object a line on stderr and nothing else there, for programs that watch.

`--log-format json`. Each has `event` and `time` (seconds since 1970): stage, progress, warning, log, stopping, and one
of result, stopped, error at the end.
"""

import json
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from signal import SIGINT
from typing import Any, TypeVar

import click

from ..pipelines.system.progress import BEGUN, StageEvent

T = TypeVar("T")
_SECONDS_BETWEEN = 0.2
_STDERR = 2
_AT_ONCE = 1 << 16
_target_fd: list[int] = []
"""Where the lines go while the standard error output is watched; empty: to sys.stderr."""
_stage: dict[str, Any] = {}
"""The stage that runs."""


def write_line(event: str, **values: Any) -> None:
    """{"event": ..., "time": seconds since 1970, ...}, in one piece whatever else is written."""
    _write(json.dumps({"event": event, "time": round(time.time(), 3), **values}))


def _write(line: str) -> None:
    line += "\n"
    if not _target_fd:
        sys.stderr.write(line)
        sys.stderr.flush()
        return
    rest = line.encode("ascii")
    while rest:
        rest = rest[os.write(_target_fd[-1], rest) :]


class Interrupted(click.ClickException):
    """A command that keeps nothing of what it was at was stopped."""

    exit_code = 128 + SIGINT


class JsonProgress:
    """{"event": "stage", "name", "index", "of", "state", ...} and {"event": "progress", "label", "done", "total"}, of
    these at most five a second and one at each end; with {"job"} where it is one of several."""

    def __init__(self, job: str = "") -> None:
        self._job = {"job": job} if job else {}

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items, and write a progress line every so often."""
        done, said = 0, 0.0
        self._report(label, 0, total)
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - said > _SECONDS_BETWEEN:
                said = time.monotonic()
                self._report(label, done, total)
        self._report(label, done, total, ended=True)

    def _report(self, label: str, done: int, total: int | None, **more: Any) -> None:
        write_line("progress", **self._job, **_stage, label=label, done=done, total=total, **more)

    def stage(self, event: StageEvent) -> None:
        """Write a line for the start or the end of a stage."""
        _stage.clear()
        if event.state == BEGUN:
            _stage.update(stage=event.name, index=event.index, of=event.of)
        left = event.left()
        values: dict[str, Any] = {"name": event.name, "index": event.index, "of": event.of, "state": event.state}
        if event.seconds:
            values |= {"seconds": round(event.seconds, 2), "figures": event.figures}
        write_line("stage", **self._job, **values, seconds_left=None if left is None else round(left))


class JsonHandler(logging.Handler):
    """{"event": "warning", "message"}, or {"event": "log", "level", "message"}."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record of the log as one line."""
        if record.levelno == logging.WARNING:
            write_line("warning", **_stage, message=record.getMessage())
        else:
            write_line("log", level=record.levelname.lower(), message=record.getMessage())


def is_asked_for(arguments: Iterable[str]) -> bool:
    """Whether a command line asks for JSON lines; seen before it is parsed, for errors in it are reported so."""
    words = list(arguments)
    given = [b for a, b in pairwise(words) if a == "--log-format"]
    given += [w.partition("=")[2] for w in words if w.startswith("--log-format=")]
    return given[-1:] == ["json"]


@contextmanager
def json_stderr() -> Iterator[None]:
    """Write everything on stderr as JSON lines inside this block: prints of libraries, other threads and child
    processes become {"event": "log", "level": "print"}, the outcome the last line. Always ends with SystemExit."""
    code = 0
    with _captured_stderr():
        try:
            yield
        except click.exceptions.Exit as ended:
            code = ended.exit_code
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
        except (click.Abort, KeyboardInterrupt, Interrupted) as error:
            code = Interrupted.exit_code
            write_line("stopped", signal=int(SIGINT), message=str(error), exit_code=code)
        except click.ClickException as error:
            code = error.exit_code
            write_line("error", message=error.format_message(), exit_code=code)
        except Exception as error:
            code = 1
            trace = "".join(traceback.format_exception(error))
            write_line("error", message=f"{type(error).__name__}: {error}", exit_code=code, traceback=trace)
    sys.exit(code)


@contextmanager
def _captured_stderr() -> Iterator[None]:
    """Turn what is printed on the process's stderr into lines; nothing where sys.stderr is something else (a test)."""
    try:
        real = sys.stderr.fileno() == _STDERR
    except (AttributeError, OSError, ValueError):
        real = False
    if not real:
        yield
        return
    sys.stderr.flush()
    kept, (reading, writing), before = os.dup(_STDERR), os.pipe(), sys.stderr
    os.dup2(writing, _STDERR)
    os.close(writing)
    # What was a file can be sought in, and a pipe cannot: the old stream would try.
    sys.stderr = open(_STDERR, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    _target_fd.append(kept)
    reader = threading.Thread(target=_report_prints, args=(reading,), daemon=True)
    reader.start()
    try:
        yield
    finally:
        with suppress(OSError):
            sys.stderr.flush()
        sys.stderr = before
        nowhere = os.open(os.devnull, os.O_WRONLY)  # what is printed from here on would not be JSON
        os.dup2(nowhere, _STDERR)
        os.close(nowhere)
        reader.join(timeout=2.0)  # a child that still runs holds the other end


def _report_prints(source: int) -> None:
    """A line for each line that comes; carriage returns end lines too."""
    rest = b""
    while data := os.read(source, _AT_ONCE):
        *lines, rest = (rest + data).replace(b"\r", b"\n").split(b"\n")
        for line in filter(None, lines):
            _report_print(line)
    if rest:
        _report_print(rest)


def _report_print(line: bytes) -> None:
    text = line.decode("utf-8", errors="backslashreplace")
    with suppress(OSError):
        if _is_event(text):
            _write(text)
        else:
            write_line("log", level="print", message=text)


def _is_event(text: str) -> bool:
    """Whether it is a line of `write_line` already, as a process of this program has written it that works for it."""
    try:
        return text.isascii() and {"event", "time"} <= json.loads(text).keys()
    except (ValueError, AttributeError):
        return False
