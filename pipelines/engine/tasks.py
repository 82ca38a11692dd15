"""A stage's work divided into tasks, which any number of processes take from the run's folder on a shared disk.

Whoever has the run's lock leads: it runs the stages, and publishes the tasks of a stage as files in the run. Every
process, the leader too, does those of its own share first, then whatever nobody works on. So one process alone ends
the run as any number of them do, in any order; one that is killed leaves its task, or its lead, to the others.
"""

from __future__ import annotations

import functools
import hashlib
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, is_dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from ...formats.atomic import unique_temp_names
from ...formats.errors import InputError, RecoverableError
from ...formats.reading import resolve_own
from ...formats.textfile import read_json, write_json
from ..config import Config
from ..run.folder import RunFolder
from ..run.lock import take_lock
from ..system.identity import package_digest
from ..system.progress import Progress, stop_if_asked
from ..system.values import load_value, name_of, of_name, save_value
from .stages import StageContext, stopping_after_writes

T = TypeVar("T")
R = TypeVar("R")
BETWEEN_LOOKS = 0.5
"""Seconds."""
TASK_MODULES = (
    "msgs_slam.pipelines.frames.tasks",
    "msgs_slam.pipelines.proxy.tasks",
    "msgs_slam.pipelines.mapping.submap_tasks",
    "msgs_slam.pipelines.export.mesh",
)
"""Where functions that do tasks are defined: a run from elsewhere could name any function of the program."""
_TASKS, _HEADER = ".tasks", "ready.json"
_CHUNKS_PER_WORKER = 3
"""Tasks a worker, so that all end at about the same time."""
_COMPUTE = ("torch", "numpy", "scipy", "pycolmap", "numba", "opencv-python-headless", "scikit-image")


@dataclass(frozen=True)
class Chunk:
    """The things first to last - 1 (keyframes, blocks of pairs, regions of a mesh), in a stage's unfinished `folder`;
    `file` holds what is known of all of them, and `opened` is what the stage has open already where its own process
    does the task."""

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
        """Return the stage's context; a task hands out none itself."""
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


@dataclass(frozen=True)
class Shard:
    """Share of many things alike (recordings, tasks): those whose number modulo `count` is `index`."""

    index: int = 0
    count: int = 1

    @staticmethod
    def parse(text: str) -> Shard:
        """Read a share such as `3/16`, counted from 0. Raises InputError for anything else."""
        index, _, count = text.partition("/")
        if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
            raise InputError(f"--shard {text}: expected K/N with K from 0 to N - 1, for example 3/16")
        return Shard(int(index), int(count))

    def of(self, things: Sequence[T]) -> list[T]:
        """Select the things of this share."""
        return list(things[self.index :: self.count])


@dataclass(frozen=True)
class SharedWorkers:
    """This process, and every other one that takes tasks from the run's folder.

    Args:
        shard: this process's share; at_once is the number of shares.
        prepare: sets logging up for a named task and returns its progress.
        threads: CPU threads of each process.
    """

    shard: Shard
    prepare: Callable[[str], Progress]
    threads: int

    @property
    def at_once(self) -> int:
        """Number of processes that may work at the same time."""
        return self.shard.count

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """Publish the tasks, work on them here and elsewhere, and gather the results; see `TaskWorkers.each`."""
        board = TaskBoard.publish(work, tasks, folder, self.threads)
        while missing := board.missing():
            stop_if_asked()
            if not board.do_one(self.shard, self.prepare) and missing == board.missing():
                time.sleep(BETWEEN_LOOKS)
        return board.collect()


@dataclass(frozen=True)
class TaskBoard:
    """Tasks of one kind in a folder of the run: NNNN.npz each, NNNN.lock which the process holds that works on it, and
    NNNN.done.npz with what it has returned. They may be taken while ready.json is there."""

    folder: Path

    @staticmethod
    def publish(work: Callable[..., Any], tasks: Sequence[Any], folder: Path, threads: int) -> TaskBoard:
        """Write the tasks of the stage whose unfinished folder that is, the header last.

        Args:
            work: a function of a module of `TASK_MODULES`, of a task and a progress.
            tasks: what `save_value` can write.
            folder: of the stage; tasks leave files below it.
            threads: that every process uses for a task: the same everywhere, or the results would differ.
        """
        unique = hashlib.sha256(f"{folder.name} {work.__name__} {time.time_ns()}".encode()).hexdigest()[:12]
        board = TaskBoard(folder.parent / _TASKS / f"{work.__name__}-{unique}")
        for number, task in enumerate(tasks):
            save_value(board.task(number), task)
        header = {"work": name_of(work), "folder": folder.name, "threads": threads, "count": len(tasks)}
        write_json(board.folder / _HEADER, {**header, "code": code_identity()})
        return board

    def task(self, number: int) -> Path:
        """Path of the file that holds a task."""
        return self.folder / f"{number:04d}.npz"

    def done(self, number: int) -> Path:
        """Path of the file that holds what a task has returned."""
        return self.folder / f"{number:04d}.done.npz"

    def missing(self) -> list[int]:
        """Tasks that are not done."""
        return [n for n in range(self._header()["count"]) if not self.done(n).exists()]

    def collect(self) -> list[Any]:
        """Load the results in the order of the tasks, and retire the board."""
        found = [load_value(self.done(n)) for n in range(self._header()["count"])]
        self.retire()
        return found

    def _header(self) -> dict[str, Any]:
        return read_json(self.folder / _HEADER)

    def do_one(self, shard: Shard, prepare: Callable[[str], Progress]) -> bool:
        """Do one that nobody works on, of the shard's own first; whether there was any."""
        try:
            header = self._header()
        except InputError:  # retired
            return False
        own = set(range(shard.index, header["count"], shard.count))
        numbers = sorted(range(header["count"]), key=lambda n: (n not in own, (n - shard.index) % header["count"]))
        return any(self._do(n, header, prepare) for n in numbers)

    def _do(self, number: int, header: dict[str, Any], prepare: Callable[[str], Progress]) -> bool:
        try:
            stream = (self.folder / f"{number:04d}.lock").open("ab")
        except FileNotFoundError:  # retired
            return False
        with stream:
            if self.done(number).exists() or not take_lock(stream):
                return False
            # The process that held the lock before may have done the task, and the leader may have retired the board.
            if self.done(number).exists() or not (self.folder / _HEADER).exists():
                return False
            self._do_locked(number, header, prepare)
        return True

    def _do_locked(self, number: int, header: dict[str, Any], prepare: Callable[[str], Progress]) -> None:
        """Raises RecoverableError where this process cannot do the task; what else the work raises is a bug."""
        root = self.folder.parents[1]
        kind, folder = header["work"].rpartition(":")[2], resolve_own(root, header["folder"])
        progress = prepare(name := f"{kind} {number + 1}")
        try:
            require_same_world([folder], header["code"])
        except InputError as error:
            raise RecoverableError(f"{name}: {error}") from error
        set_threads(header["threads"])
        work = of_name(header["work"])
        if work.__module__ not in TASK_MODULES:
            raise InputError(
                f"{self.folder / _HEADER}: {header['work']} is not a task of this program. Delete {self.folder}"
            )
        _require_inside(root, task := load_value(self.task(number)))
        # On a disk without locks another process may do the same task.
        with stopping_after_writes(folder), unique_temp_names():
            try:
                value = work(task, progress)
            except InputError as error:
                raise RecoverableError(f"{name}: on the node {platform.node()}: {error}") from error
            save_value(self.done(number), value)

    def retire(self) -> None:
        """Let no process take a task any more; waits for those that work on one, and removes the board."""
        with suppress(FileNotFoundError):
            (self.folder / _HEADER).unlink()
        for lock in (path for path in sorted(self.folder.glob("*.lock")) if not path.is_symlink()):
            with lock.open("ab") as stream:
                while not take_lock(stream):
                    stop_if_asked()
                    time.sleep(BETWEEN_LOOKS)
        for _ in range(20):  # a process that looks in now may leave a lock, and a disk may release one late
            shutil.rmtree(self.folder, ignore_errors=True)
            if not self.folder.exists():
                break
            time.sleep(BETWEEN_LOOKS / 5)
        with suppress(OSError):
            self.folder.parent.rmdir()


def boards_in(run: RunFolder) -> list[TaskBoard]:
    """Find the task boards of a run, published now or left by an earlier leader."""
    with suppress(FileNotFoundError):
        found = sorted(run.path(_TASKS).iterdir())
        return [TaskBoard(folder) for folder in found if folder.is_dir() and not folder.is_symlink()]
    return []


def _require_inside(root: Path, task: Any) -> None:
    """Raise InputError for a task that would write elsewhere than in the run."""
    held = [value for name, value in vars(task).items() if name != "source"] if is_dataclass(task) else []
    places = [value.root if isinstance(value, RunFolder) else value for value in held]
    for place in places:
        if isinstance(place, Path) and not place.resolve().is_relative_to(root.resolve()):
            raise InputError(f"{root}: a task is of {place}, outside of the run. Delete {root / _TASKS}")


def require_same_world(folders: Sequence[Path], code: str) -> None:
    """Raise InputError unless this node sees the folders, and has what the others have (`code_identity`)."""
    node = platform.node()
    for folder in folders:
        if not folder.exists():
            raise InputError(
                f"the node {node} does not see {folder}: sources and runs must lie on a disk that all nodes have under "
                "the same path"
            )
    theirs, ours = (dict(part.partition("=")[::2] for part in c.split(" ")) for c in (code, code_identity()))
    for name in {**ours, **theirs}:
        if (found := ours.get(name, "none")) != (wanted := theirs.get(name, "none")):
            raise InputError(
                f"the node {node} has another version of {name} ({found[:12]}, not {wanted[:12]}), so that its results "
                "would differ: install the same on every node"
            )


@functools.cache
def code_identity() -> str:
    """List what results depend on: the program's stages, Python, the libraries that compute; name=version of each."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"msgs-slam": package_digest(), "Python": platform.python_version()}
    for name in _COMPUTE:
        try:
            found[name] = version(name).partition("+")[0]  # +cpu, +cu128: the device is a setting
        except PackageNotFoundError:
            found[name] = "none"
    return " ".join(f"{name}={value}" for name, value in found.items())


def set_threads(threads: int) -> None:
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
