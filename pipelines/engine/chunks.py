"""A stage's work on many things alike (keyframes, blocks of pairs, regions of a mesh) as tasks over ranges of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from ..config import Config
from ..run.folder import RunFolder
from ..system.progress import Progress
from ..system.values import load_value, save_value
from .stages import StageContext

R = TypeVar("R")
_CHUNKS_PER_WORKER = 3
"""Tasks a worker, so that all end at about the same time."""


@dataclass(frozen=True)
class Chunk:
    """The things first to last - 1, in a stage's unfinished `folder`; `file` tells what is known of all of them, and
    `opened` is what the stage has open already where its own process does the task."""

    run: RunFolder
    source: Path
    config: Config
    folder: Path
    file: Path
    first: int
    last: int
    opened: Any = None

    @property
    def numbers(self) -> range:
        """Numbers of the things."""
        return range(self.first, self.last)

    @cached_property
    def known(self) -> dict[str, Any]:
        """Facts about all things of the stage, by name, from `file`."""
        return load_value(self.file)

    def context(self, progress: Progress) -> StageContext:
        """The stage's; a task hands out none itself."""
        return StageContext(self.run, self.source, self.config, self.folder, progress)


def in_chunks(
    context: StageContext, work: Callable[[Chunk, Progress], R], count: int, opened: Any = None, **known: Any
) -> list[R]:
    """Do `work` on ranges of `count` things, with what is `known` of all; returns its results in order.

    This process alone does all of them as one range; workers get several each. Either way a task has what it needs
    from files, and leaves files in the stage's folder.
    """
    file = context.snapshot / f"{work.__name__}.npz"
    save_value(file, known)
    wanted, here = (_CHUNKS_PER_WORKER * context.workers.at_once, None) if context.workers else (1, opened)
    parts = max(min(wanted, count), 1)
    ends = [count * n // parts for n in range(parts + 1)]
    task = Chunk(context.run, context.source, context.config, context.folder, file, 0, 0, here)
    return context.each(work, [replace(task, first=a, last=b) for a, b in pairwise(ends)])
