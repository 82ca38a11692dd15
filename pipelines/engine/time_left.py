"""The time that a run still takes, by how long its stages so far have taken."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

SHARES = {"frames": 16, "proxy": 33, "tracking": 5, "mapping": 37, "global_ba": 1, "export": 8}
"""Of the seconds of a run: the median of five recordings (two rooms, the demo, two walks)."""


@dataclass
class TimeLeft:
    """Time left for the stages `wanted`, in order: what the stages that are done, by this process or another, have
    taken in `seconds` tells how fast it goes here. As long as no stage is done nothing is known."""

    seconds: dict[str, float]
    wanted: Sequence[str]
    _waiting: list[str] = field(default_factory=list)
    _begun: float | None = None

    def begin(self, name: str) -> None:
        """Note that this stage begins: it and those after it are to be made."""
        self._waiting, self._begun = list(self.wanted[self.wanted.index(name) :]), time.monotonic()
        self.seconds = {k: v for k, v in self.seconds.items() if k not in self._waiting}

    def end(self, name: str, seconds: float) -> None:
        """Note that this stage has ended."""
        self.seconds[name], self._begun = seconds, None
        self._waiting.remove(name)

    def left(self) -> float | None:
        """Seconds to the end of all, by the time that it is now; None where nothing is known."""
        if not self.seconds:
            return None
        speed = sum(self.seconds.values()) / sum(SHARES[name] for name in self.seconds)
        expected = [speed * SHARES[name] for name in self._waiting]
        if self._begun is not None:
            # A stage that takes longer than estimated has still some of its time to go.
            expected[0] = max(expected[0] - (time.monotonic() - self._begun), 0.1 * expected[0])
        return sum(expected)
