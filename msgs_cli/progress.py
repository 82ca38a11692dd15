"""Progress on stderr: one tqdm bar a piece of work."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")


class BarProgress:
    """Bars with counts and time left; they stay when done, so that the log of a run can be read afterwards."""

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and show how many are done."""
        yield from tqdm(items, desc=f"{label:<28}", total=total, mininterval=0.2, dynamic_ncols=True, unit="")
