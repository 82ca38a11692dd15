"""Into how many windows structure from motion divides a long recording: by its length, and the memory that is given."""

from itertools import pairwise

import numpy as np

from ..system.memory import NEEDS

SIZE, SHARED = 500, 40
"""Keyframes of a window, and those that it shares with the one before. All at once is surer (0.20 cm against 0.26 in
windows of 32 of a walk of 77 keyframes, the one recording tried), while there is room for it."""
_LEAST_SIZE = 100


def window_size(memory_mb: int, pixels: int) -> int:
    """Keyframes of a window for `run.memory_mb` and images of so many pixels; where that is not given (0) always as
    many: what comes out does not depend on the machine."""
    if memory_mb == 0:
        return SIZE
    least, a_million_pixels, a_keyframe, _ = NEEDS["frames"]
    return int(np.clip((memory_mb - least - a_million_pixels * pixels / 1e6) / a_keyframe, _LEAST_SIZE, SIZE))


def windows_of(count: int, size: int = SIZE, shared: int = SHARED) -> list[range]:
    """All keyframes in windows of about that size; one window for less than half as much again. For a size of more than
    twice what is shared none is in three windows."""
    parts = max(1, round((count - shared) / (size - shared))) if count > 1.5 * size else 1
    shared *= parts > 1
    edges = np.linspace(0, count - shared, parts + 1).round().astype(int).tolist()
    return [range(a, b + shared) for a, b in pairwise(edges)]
