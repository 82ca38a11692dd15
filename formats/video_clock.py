"""Times of frames: as a container stores them, made to increase."""

import itertools
import math
import statistics

_SHORTEST_STEP = 1e-6
_LONGEST_STEP, _LONGEST_IN_PARTS, _USUAL_STEPS = 3600.0, 10.0, 100
"""Seconds between two frames beyond which the clock has jumped, if they are so many usual steps too: of any file, and
of formats that can be joined end to end, where each part has a clock of its own."""


def longest_step(head: bytes) -> float:
    """Return the seconds beyond which a step is a jump of the clock, by the first bytes of a file.

    MPEG's transport stream (of 188 bytes, or 192 with a time before each), its program stream, Flash Video and Ogg are
    files of several parts where two of them were written one after the other.
    """
    is_transport = any(head[at : at + 1] == head[at + n : at + n + 1] == b"G" for at, n in ((0, 188), (4, 192)))
    is_joinable = is_transport or head.startswith((b"\0\0\1\xba", b"FLV", b"OggS"))
    return _LONGEST_IN_PARTS if is_joinable else _LONGEST_STEP


class Clock:
    """Container times made strictly increasing, with the first frame at 0."""

    def __init__(self, fps: float, longest: float = _LONGEST_STEP) -> None:
        self.times: list[float] = []
        self.repairs = self.restarts = 0
        self._nominal_step, self._longest = 1.0 / fps, longest
        self._start = 0.0
        self._outlier: float | None = None

    def next(self, stored: float) -> float:
        """Return the time of the next frame, given what the container says (any float, NaN and negative included)."""
        if not self.times:
            self._start = stored if math.isfinite(stored) else 0.0
        self.times.append(self._after(self.times[-1], stored) if self.times else 0.0)
        return self.times[-1]

    def _after(self, previous: float, stored: float) -> float:
        if self._follows(previous, stored - self._start):
            self._outlier = None
            return stored - self._start
        if self._outlier is not None and self._follows(self._outlier, stored):
            # Two in a row: the frame before was not a wrong one but the first by another clock.
            self._start, self._outlier = self._outlier - previous, None
            self.repairs, self.restarts = self.repairs - 1, self.restarts + 1
            return stored - self._start
        self.repairs += 1
        self._outlier = stored
        return previous + self._typical_step()

    def _follows(self, before: float, after: float) -> bool:
        step = after - before  # not finite where the container says nothing
        return _SHORTEST_STEP < step <= self._longest or (self._longest < step <= _USUAL_STEPS * self._typical_step())

    def _typical_step(self) -> float:
        recent = self.times[-16:]
        steps = [b - a for a, b in itertools.pairwise(recent)]
        return statistics.median(steps) if steps else self._nominal_step
