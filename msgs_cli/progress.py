"""Progress at a terminal: one tqdm bar a piece of work."""

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

from tqdm import tqdm

from ..pipelines.system.progress import BEGUN, ENDED, UP_TO_DATE, StageEvent
from ..pipelines.system.stopping import is_asked

T = TypeVar("T")
_FORMAT = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"
_WIDTH = 32
"""Of what is before the bar."""


class BarProgress:
    """Bars with the stage, counts, the time left of each and, at its end, of the whole job."""

    def __init__(self) -> None:
        self._event: StageEvent | None = None

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and show how many are done. A bar that ends early is full, for nothing is left to do, but for
        one that a signal ends."""
        title = f"{self._event.title} " if self._event else ""
        with tqdm(total=total, desc=f"{title}{label}".ljust(_WIDTH), mininterval=0.2, dynamic_ncols=True,
                  bar_format=_FORMAT) as bar:  # fmt: skip
            try:
                for item in items:
                    yield item
                    self._show_left(bar)
                    bar.update()
            finally:
                if not is_asked():
                    bar.total = bar.n
                bar.refresh()

    def _show_left(self, bar: tqdm) -> None:
        if self._event is not None:
            bar.set_postfix_str(self._event.left_text.removeprefix("; ").replace("left", "to the end"), refresh=False)

    def stage(self, event: StageEvent) -> None:
        """Say which stage begins, and how long one that has ended took."""
        self._event = event if event.state == BEGUN else None
        if event.state == ENDED:
            tqdm.write(f"{event.title} done in {event.seconds:.0f} s{event.left_text}", file=sys.stderr)
        elif event.state == UP_TO_DATE:
            tqdm.write(f"{event.title} up to date", file=sys.stderr)
