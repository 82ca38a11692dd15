"""How a stage tells of its progress, whoever shows it."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")
_SECONDS_BETWEEN_LINES = 30.0
log = logging.getLogger("msgs_slam")


class Progress(Protocol):
    """Shows one bar a piece of work."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and show how many are done."""
        ...


class LineProgress:
    """A line on stderr at the end of each piece of work, and every half minute of it: for who watches from afar."""

    def __init__(self, name: str) -> None:
        self.name = name

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items."""
        done, said = 0, time.monotonic()
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - said > _SECONDS_BETWEEN_LINES:
                said = time.monotonic()
                self._say(label, done, total)
        self._say(label, done, total)

    def _say(self, label: str, done: int, total: int | None) -> None:
        print(f"{self.name}: {label} {done}" + (f" of {total}" if total else ""), file=sys.stderr, flush=True)


class SilentProgress:
    """Shows nothing."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items."""
        yield from items
