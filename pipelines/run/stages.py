"""Stages of a run: what each is, everything that it is given, and the tasks into which it divides its work: ranges of
keyframes, pairs or regions, done here or on the nodes of a cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ...formats.atomic import after_each_write
from ..config import Config
from ..system.identity import package_digest
from ..system.machine import available_cpus, memory_room, release_free_memory, resolve_device
from ..system.progress import Progress, log, stop_if_asked
from .ending import SNAPSHOT
from .folder import RunFolder
from .reads import active_log
from .schema import RunFile

T = TypeVar("T")
R = TypeVar("R")
SameSource = Callable[[], None]
_CHUNKS_PER_WORKER = 3
"""Tasks a worker, so that all end at about the same time."""


def trust_source() -> None:
    """Accept the source as it is."""


class TaskWorkers(Protocol):
    """Workers that take the tasks of a stage."""

    @property
    def at_once(self) -> int:
        """Number of tasks that may run at the same time."""
        ...

    @property
    def threads(self) -> int:
        """Threads that each takes: the same everywhere, or the results would differ."""
        ...

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path, progress: Progress) -> list[R]:
        """Do `work` on every task, below `folder`, a stage's unfinished one; returns its results in order."""
        ...


@dataclass(frozen=True)
class StageContext:
    """Everything that a stage is given.

    `folder` is the stage's own unfinished folder, into which `save` writes its results; `snapshot` inside it is removed
    when the stage ends well. What an interrupted attempt with the same settings and inputs has left there is still
    there when the stage starts again. `stages` are all of the run; `same_source` raises RecoverableError where the
    source is not, or no longer, what the run was begun from; `workers` take the tasks that a stage is divided into,
    None for this process.
    """

    run: RunFolder
    source: Path
    config: Config
    folder: Path
    progress: Progress
    warnings: list[str] = field(default_factory=list)
    stages: list[Stage] = field(default_factory=list)
    same_source: SameSource = trust_source
    workers: TaskWorkers | None = None

    @property
    def snapshot(self) -> Path:
        """Folder for snapshots; made on first use."""
        path = self.folder / SNAPSHOT
        path.mkdir(exist_ok=True)
        return path

    @property
    def threads(self) -> int:
        """Number of CPU threads to use."""
        return self.config.run.threads or available_cpus()

    @property
    def memory_room(self) -> float:
        """Bytes of memory to plan with."""
        return memory_room(self.config.run.memory_mb)

    @property
    def device(self) -> str:
        """Device of dense work, "cpu" or "cuda"."""
        return resolve_device(self.config.run.device)

    def save(self, file: RunFile[T], value: T, of: int | str = "", piece: str = "") -> Path:
        """Leave a file of the run's table, `of` which frame, in the folder of which `piece`; returns its path."""
        return file.save(self.folder / piece, value, of)

    def find(self, file: RunFile[T], of: int | str = "") -> T | None:
        """Read a file that the stage has left already, None where it has not."""
        return file.find(self.folder, of)

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T]) -> list[R]:
        """Do `work`, a function of a module's top level, on every task, here, one after the other, or by the workers;
        returns its results in order. A task leaves files below `folder`, and does nothing where they are."""
        if self.workers is None:
            return [_done(work, task, self.progress) for task in tasks]
        log = active_log()
        return self.workers.each(work if log is None else log.for_task(work), tasks, self.folder, self.progress)

    def warn(self, message: str) -> None:
        """A degraded result: logged now, counted and kept for the report."""
        log.warning(message)
        self.warnings.append(message)


def _done(work: Callable[[T, Progress], R], task: T, progress: Progress) -> R:
    result = work(task, progress)
    release_free_memory()
    return result


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


@dataclass(frozen=True)
class LazyFunction:
    """A function of a module below pipelines/ that is imported when it is called, so that `status` starts fast."""

    module: str
    name: str = "run"

    @property
    def function(self) -> Callable[..., Any]:
        """The function; imports its module."""
        function: Callable[..., Any] = getattr(import_module(f"...{self.module}", __name__), self.name)
        return function

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.function(*args)


@dataclass(frozen=True)
class Stage:
    """`run` does the work and returns its key figures.

    `check` refuses files and networks that it could not use: it sees (source, config) before the first stage runs, so
    that a mistake is told of before anything slow. `check_settings` refuses what the settings alone show to be wrong,
    before any `check` loads libraries. `division`: into which parts the work of a finished stage is divided
    with these settings, where the memory that is given decides that and the result with it.
    """

    name: str
    run: Callable[[StageContext], dict[str, Any]]
    check: Callable[[Path, Config], None] | None = None
    division: Callable[[RunFolder, Config], Any] | None = None
    check_settings: Callable[[Config], Any] | None = None

    @property
    def program(self) -> str:
        """Identity of what computes it: the package and, as methods differ, the function."""
        of = self.run
        return f"{package_digest()} {f'{of.module}.{of.name}' if isinstance(of, LazyFunction) else self.name}"


def stopping_after_writes(folder: Path) -> AbstractContextManager[None]:
    """Stop the work in this block where the user has asked for it, after a file below a stage's folder is written:
    nothing is lost then."""
    return after_each_write(lambda path: stop_if_asked() if path.is_relative_to(folder) else None)
