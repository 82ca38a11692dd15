"""Estimate of the time that the rest of a run will take, by what its stages have taken so far."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

_SHARES = {"frames": 16, "proxy": 33, "tracking": 5, "mapping": 37, "global_ba": 1, "export": 8}
"""Per cent of the whole: the median of five recordings (kitchen, whiteroom, the demo, walks of 15 and 60 s)."""


class TimeLeft:
    """Time left for the stages `wanted`, in order: `seconds` of those that are done, by this process or another, tell
    how fast it goes here. Right to a factor of about two; as long as no stage is done nothing is known."""

    def __init__(self, wanted: Sequence[str], seconds: Mapping[str, float]) -> None:
        self._wanted, self._seconds = list(wanted), dict(seconds)
        self._waiting: list[str] = []
        self._begun: float | None = None

    def begin(self, name: str) -> None:
        """This stage begins: it and those after it are to be made."""
        self._waiting, self._begun = self._wanted[self._wanted.index(name) :], time.monotonic()
        self._seconds = {k: v for k, v in self._seconds.items() if k not in self._waiting}

    def end(self, name: str, seconds: float) -> None:
        """This stage has ended."""
        self._seconds[name], self._begun = seconds, None
        self._waiting.remove(name)

    def left(self) -> float | None:
        """Seconds to the end of all, by the time that it is now; None where nothing is known."""
        done = sum(_SHARES[name] for name in self._seconds)
        if not done:
            return None
        a_share = sum(self._seconds.values()) / done
        expected = [a_share * _SHARES[name] for name in self._waiting]
        if self._begun is not None:
            # A stage that takes longer than thought is not thought to end at once.
            expected[0] = max(expected[0] - (time.monotonic() - self._begun), 0.1 * expected[0])
        return sum(expected)
