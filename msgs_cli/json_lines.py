"""What happens, as one JSON object a line on stderr, for programs that watch (`--log-format json`)."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterable, Iterator
from typing import IO, Any, TypeVar

import click

T = TypeVar("T")
_SECONDS_BETWEEN = 0.2


def write_line(event: str, **values: Any) -> None:
    """{"event": progress, log or error, "time": seconds since 1970, ...}."""
    line = json.dumps({"event": event, "time": round(time.time(), 3), **values})
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


class JsonProgress:
    """{"event": "progress", "label", "done", "total"}, at most five a second and one at each end."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items."""
        done, said = 0, 0.0
        write_line("progress", label=label, done=0, total=total)
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - said > _SECONDS_BETWEEN:
                said = time.monotonic()
                write_line("progress", label=label, done=done, total=total)
        write_line("progress", label=label, done=done, total=total, ended=True)


class JsonHandler(logging.Handler):
    """{"event": "log", "level", "message"}."""

    def emit(self, record: logging.LogRecord) -> None:
        """One line."""
        write_line("log", level=record.levelname.lower(), message=record.getMessage())


class JsonError(click.ClickException):
    """{"event": "error", "message"}, exit code 1."""

    def show(self, file: IO[Any] | None = None) -> None:
        """One line."""
        write_line("error", message=self.message)
