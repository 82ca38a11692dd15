"""Events of a run as one JSON object a line on stderr, for programs that watch; libraries may print text there too.

`--log-format json`. Each has `event` and `time` (seconds since 1970): stage, progress, warning, log, stopping, and one
of result, stopped, error at the end.
"""

import json
import logging
import sys
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from signal import SIGINT
from typing import Any, TypeVar

import click

from ..pipelines.system.progress import BEGUN, StageEvent

T = TypeVar("T")
_SECONDS_BETWEEN = 0.2
_stage: dict[str, Any] = {}
"""The stage that runs."""


def write_line(event: str, **values: Any) -> None:
    """{"event": ..., "time": seconds since 1970, ...}, in one piece whatever else is written."""
    sys.stderr.write(json.dumps({"event": event, "time": round(time.time(), 3), **values}) + "\n")
    sys.stderr.flush()


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
def json_outcome() -> Iterator[None]:
    """Report how the command in this block ends as a JSON line. Always ends with SystemExit."""
    code = 0
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
