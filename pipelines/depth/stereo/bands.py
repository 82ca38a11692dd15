"""Row bands on threads: the same bytes whatever the number of threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

BAND_ROWS = 16


class Bands:
    """Runs kernels that release the interpreter lock over bands of rows; every band writes only its own rows."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def run(self, count: int, work: Callable[[int, int], object], size: int = BAND_ROWS) -> None:
        """Call `work(first, last)` for consecutive bands of 0..count. The bands do not depend on the threads."""
        starts = range(0, count, size)
        if self._pool is None:
            for start in starts:
                work(start, min(start + size, count))
            return
        for future in [self._pool.submit(work, s, min(s + size, count)) for s in starts]:
            future.result()

    def close(self) -> None:
        """Wait for the threads to end."""
        if self._pool is not None:
            self._pool.shutdown()
