"""Workers that are this process, to whom tasks come as files, as to others, and who hand results back so."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.values import load_value, name_of, of_name, save_value


@dataclass
class Travelling:
    """As many as `at_once`; counts the tasks of each kind."""

    folder: Path
    at_once: int

    def __post_init__(self) -> None:
        self.done: dict[str, int] = {}

    def each(self, work: Callable[..., Any], tasks: Sequence[Any], folder: Path) -> list[Any]:
        assert of_name(name_of(work)) is work
        self.done[work.__name__] = self.done.get(work.__name__, 0) + len(tasks)
        return [self._sent(work(self._sent(task), SilentProgress())) for task in tasks]

    def _sent(self, value: Any) -> Any:
        save_value(self.folder / "sent.npz", value)
        return load_value(self.folder / "sent.npz")
