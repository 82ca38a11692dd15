"""Workers that are this process, to which tasks and results come pickled, as by a cluster."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_slam.pipelines.system.progress import Progress, SilentProgress


@dataclass
class Travelling:
    """As many as `at_once`; counts the tasks of each kind."""

    at_once: int
    threads: int = 1

    def __post_init__(self) -> None:
        self.done: dict[str, int] = {}

    def each(self, work: Callable[..., Any], tasks: Sequence[Any], folder: Path, progress: Progress) -> list[Any]:
        self.done[work.__name__] = self.done.get(work.__name__, 0) + len(tasks)
        work = pickle.loads(pickle.dumps(work))
        return [_sent(work(_sent(task), SilentProgress())) for task in tasks]


def _sent(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))
