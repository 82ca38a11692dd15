"""Progress of a stage, however it is shown; and stopping softly: the first signal asks, and the work ends at the next
moment at which nothing is lost."""

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
_SECONDS_BETWEEN_LINES = 600.0
log = logging.getLogger("msgs_slam")
IN_WORDS = {
    "frames": "camera poses", "proxy": "depth and classes", "tracking": "loops and remaining poses", "mapping": "map",
    "global_ba": "poses between", "export": "files",
}  # fmt: skip
"""What the stages bring, for people."""
BEGUN, ENDED, UP_TO_DATE, STOPPED, REFUSED = "begun", "done", "up to date", "stopped", "failed"


def _unknown() -> None:
    """How long it will take is not known."""


@dataclass(frozen=True)
class StageEvent:
    """Stage number `index` of `of` has come into a state: begun, done, up to date (nothing to do), stopped by a signal,
    failed. seconds and figures of one that is done; left: seconds to the end of all of them at the moment of asking,
    None where nothing is known."""

    name: str
    index: int
    of: int
    state: str
    seconds: float = 0.0
    figures: Mapping[str, Any] = field(default_factory=dict)
    left: Callable[[], float | None] = _unknown

    @property
    def title(self) -> str:
        """Heading such as "[2/6 depth and classes]"."""
        return f"[{self.index}/{self.of} {IN_WORDS.get(self.name, self.name)}]"

    @property
    def left_text(self) -> str:
        """; 3 to 5 min left, or nothing. While only the first stage has ended, half or twice as long is as likely."""
        ended, seconds = self.index - (self.state == BEGUN), self.left() or 0.0
        low, high = (0.75, 1.25) if ended > 1 else (0.5, 2)
        return f"; {between(low * seconds, high * seconds)} left" if seconds else ""


def about(seconds: float) -> str:
    """about 40 s, about 4 min, about 3 h: no finer than an estimate is good for."""
    if seconds < 55:
        return f"about {max(10 * round(seconds / 10), 10)} s"
    return f"about {round(seconds / 60)} min" if seconds < 90 * 60 else f"about {round(seconds / 3600)} h"


def between(low: float, high: float) -> str:
    """20 to 80 s, 2 to 8 min, 1 to 3 h."""
    unit, length = ("s", 10) if high < 100 else ("min", 60) if high < 90 * 60 else ("h", 3600)
    first, last = (max(round(seconds / length), 1) * (10 if unit == "s" else 1) for seconds in (low, high))
    return f"{first} to {last} {unit}" if first < last else about(high)


class Progress(Protocol):
    """Shows one bar a piece of work, and which stage it is part of."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and show how many are done."""
        ...

    def stage(self, event: StageEvent) -> None:
        """Start a stage, to which tracked items belong from now on, or end it."""
        ...


class LineProgress:
    """A line on stderr a stage, and every ten minutes of a longer one, for files and pipes."""

    def __init__(self, name: str = "") -> None:
        self._before, self._stage = f"{name}: " if name else "", ""
        self._said = time.monotonic()

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items, and print a line every so often."""
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - self._said > _SECONDS_BETWEEN_LINES:
                self._say(f"{self._stage}{label} {done}" + (f" of {total}" if total else ""))

    def stage(self, event: StageEvent) -> None:
        """Say that it has ended."""
        self._stage, self._said = f"{event.title} ", time.monotonic()
        if event.state == UP_TO_DATE:
            self._say(f"{event.title} {event.state}")
        elif event.state == ENDED:
            self._say(f"{event.title} {event.state} in {event.seconds:.0f} s{event.left_text}")

    def _say(self, text: str) -> None:
        self._said = time.monotonic()
        print(self._before + text, file=sys.stderr, flush=True)


class SilentProgress:
    """Progress that shows nothing."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items without showing anything."""
        yield from items

    def stage(self, event: StageEvent) -> None:
        """Ignore the start and end of stages."""


@dataclass(frozen=True)
class WithinStage:
    """The progress of a run that is made inside a stage of another: its stages are pieces of work called `name`."""

    progress: Progress
    name: str

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items with `name` before the label."""
        yield from self.progress.track(items, f"{self.name}: {label}", total)

    def stage(self, event: StageEvent) -> None:
        """Nothing: the stage around it is reported."""


class Stopped(KeyboardInterrupt):
    """The work was stopped by a signal, with all of it kept."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by signal {number}")
        self.number = number


_asked: list[int] = []
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def soft_stop(tell: Callable[[int], None]) -> Iterator[None]:
    """Handle signals inside this block: the first SIGINT, SIGTERM or SIGHUP calls `tell` and lets the work go on to its
    next snapshot, which raises `Stopped`; the second stops at once. An ignored signal (nohup) stays ignored.

    Does nothing outside the main thread, which alone may set handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        if _asked:
            raise Stopped(number)
        _asked.append(number)
        tell(number)

    let_libraries_take_signals()
    before: dict[Any, Any] = {}
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        _asked.clear()
        for number, handler in before.items():
            signal.signal(number, handler)


def let_libraries_take_signals() -> None:
    """COLMAP's logging takes SIGTERM, to print a stack trace and die, at the moment in which it is imported: after this
    it has been, and what is set keeps."""
    import pycolmap  # noqa: F401


def is_asked() -> bool:
    """Whether a signal has asked the work to stop: take a snapshot soon."""
    return bool(_asked)


def stop_if_asked() -> None:
    """Raise `Stopped` where a signal has asked for it. To be called where nothing is lost by stopping."""
    if _asked:
        raise Stopped(_asked[0])
