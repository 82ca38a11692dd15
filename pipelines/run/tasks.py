"""A stage's work divided into tasks: ranges of keyframes, pairs or regions, done here or on the nodes of a cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from ..config import Config
from ..system.progress import Progress
from .folder import RunFolder
from .stages import StageContext

R = TypeVar("R")
_CHUNKS_PER_WORKER = 3
"""Tasks a worker, so that all end at about the same time."""


@dataclass(frozen=True)
class Chunk:
    """The things first to last - 1 (keyframes, blocks of pairs, regions of a mesh), in a stage's unfinished `folder`;
    `known` holds what is known of all of them, and `opened` is what the stage has open already where its own process
    does the task."""

    run: RunFolder
    source: Path
    config: Config
    folder: Path
    known: dict[str, Any]
    first: int
    last: int
    opened: Any = None

    @property
    def numbers(self) -> range:
        """Numbers of the things."""
        return range(self.first, self.last)

    def context(self, progress: Progress) -> StageContext:
        """Return the stage's context; a task hands out none itself."""
        return StageContext(self.run, self.source, self.config, self.folder, progress)


def in_chunks(
    context: StageContext, work: Callable[[Chunk, Progress], R], count: int, opened: Any = None, **known: Any
) -> list[R]:
    """Do `work` on ranges of `count` things, with what is `known` of all; returns its results in order.

    This process takes all of them as one range; the workers of a cluster get several each.
    """
    wanted, here = (_CHUNKS_PER_WORKER * context.workers.at_once, None) if context.workers else (1, opened)
    parts = max(min(wanted, count), 1)
    ends = [count * n // parts for n in range(parts + 1)]
    task = Chunk(context.run, context.source, context.config, context.folder, known, 0, 0, here)
    return context.each(work, [replace(task, first=a, last=b) for a, b in pairwise(ends)])


def limit_threads(threads: int) -> None:
    """Let the libraries of this process use so many CPU threads; 0 leaves it to them."""
    if threads == 0:
        return
    import cv2
    import scipy.linalg  # noqa: F401 (loads a BLAS of its own, whose threads are limited below)
    import torch
    from threadpoolctl import threadpool_limits

    from ..compute.threads import set_threads

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)
    # Of numpy's and scipy's BLAS: on more its sums are others, and on the small matrices here they wait for each other
    # longer than they work, on a busy machine twenty times as long. Threads of ours call it side by side.
    threadpool_limits(1, "blas")
