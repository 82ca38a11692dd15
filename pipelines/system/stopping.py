"""Stopping softly: the first signal asks, and the work ends at the next moment at which nothing is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


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
