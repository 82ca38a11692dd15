"""A process that ends at a chosen moment, for tests that go on after it."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from msgs_slam.pipelines.system.progress import SilentProgress

T = TypeVar("T")


class Killed(Exception):
    """Stands for the end of the process."""


class KillAt(SilentProgress):
    """Ends the work when the n-th item of a bar has been handed out: of any, or of those called `label`."""

    def __init__(self, item: int, label: str = "") -> None:
        self._item, self._label = item, label

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        for i, item in enumerate(items):
            if self._label in ("", label) and i == self._item:
                raise Killed
            yield item
