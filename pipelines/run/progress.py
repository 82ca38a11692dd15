"""Progress of the process that works on a run, in a small file for others to read, and the time that is left."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any, TypeVar

from ...formats.errors import InputError
from ...formats.textfile import read_json
from ..system.progress import BEGUN, Progress, StageEvent, about
from ..system.values import dataclass_from_json
from .folder import RunFolder
from .lock import is_locked

T = TypeVar("T")
PROGRESS = ".progress.json"
_BETWEEN_WRITES = 2.0
"""Seconds between two notes of progress."""
_SHARES = {"frames": 20, "proxy": 28, "tracking": 5, "mapping": 28, "global_ba": 3, "export": 16}
_OF_DRAFT = {"frames": 38, "proxy": 25, "tracking": 11, "mapping": 16, "global_ba": 0.5, "export": 10}
"""Of the seconds of a run: medians of sixteen and of seven runs of ten recordings."""
_EARLIER = 0.5
"""A stage counts so much less than the one after it: other programs come and go. After `mapping` 17 instead of 14 of 23
runs are then told within a quarter; after `proxy`, 13 instead of 12."""


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
        """running, features 57%, about 4 min left"""
        share = f", {self.label} {100 * self.done // self.of}%" if self.of else ""
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
        with suppress(OSError):  # the work does not stop for it
            temporary.unlink(missing_ok=True)  # never through a link that was there
            with temporary.open("x", encoding="utf-8") as file:
                file.write(json.dumps(asdict(now)))
            os.replace(temporary, self._file)


def load_run_progress(run: RunFolder) -> RunProgress | None:
    """Load the progress of the process at work; None where there is none, or no stage has started."""
    path = run.path(PROGRESS)
    if not path.exists() or not is_locked(run):
        return None
    with suppress(InputError, ValueError):
        return dataclass_from_json(RunProgress, read_json(path))
    return None


@dataclass
class TimeLeft:
    """Time left for the stages `wanted`, in order: what the stages that are done, by this process or another, have
    taken in `seconds` tells how fast it goes here. As long as no stage is done nothing is known. `pieces`: frames of
    other pieces for each of the main one's; `export` makes them whole."""

    seconds: dict[str, float]
    wanted: Sequence[str]
    is_draft: bool = False
    pieces: float = 0.0
    _waiting: list[str] = field(default_factory=list)
    _begun: float | None = None

    def begin(self, name: str) -> None:
        """Note that this stage begins: it and those after it are to be made."""
        self._waiting, self._begun = list(self.wanted[self.wanted.index(name) :]), time.monotonic()
        self.seconds = {k: v for k, v in self.seconds.items() if k not in self._waiting}

    def end(self, name: str, seconds: float, figures: Mapping[str, Any]) -> None:
        """Note that this stage has ended, with these figures."""
        self.seconds[name], self._begun = seconds, None
        self.pieces = in_pieces(figures) or self.pieces
        self._waiting.remove(name)

    def left(self) -> float | None:
        """Seconds to the end of all, by the time that it is now; None where nothing is known."""
        if not self.seconds:
            return None
        shares = dict(_OF_DRAFT if self.is_draft else _SHARES)
        shares["export"] += self.pieces * (sum(shares.values()) - shares["frames"])
        counts = {name: _EARLIER**k for k, name in enumerate(reversed(self.seconds))}
        taken = sum(counts[name] * seconds for name, seconds in self.seconds.items())
        speed = taken / sum(counts[name] * shares[name] for name in self.seconds)
        expected = [speed * shares[name] for name in self._waiting]
        if self._begun is not None:
            # A stage that takes longer than estimated has still some of its time to go.
            expected[0] = max(expected[0] - (time.monotonic() - self._begun), 0.1 * expected[0])
        return sum(expected)


def in_pieces(figures: Mapping[str, Any]) -> float:
    """Count the frames that the figures of `tracking` say to be in other pieces, for each of the main one's."""
    return sum(figures.get("pieces", ())) / max(figures.get("posed", 0), 1)
