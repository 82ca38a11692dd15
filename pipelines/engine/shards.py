"""Many processes at one run, over a shared folder alone: whoever has the run's lock leads, the others help.

The leader runs the stages; where one has tasks it posts them as files in the run. Everybody, the leader too, does
those of his own share first, then whatever nobody works on. So one process alone ends the run as any number of them do,
in any order; one that is killed leaves its task, or its lead, to the others.
"""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ...formats.atomic import own_temporaries
from ...formats.errors import InputError, RecoverableError
from ...formats.jsonfile import read_json, write_json
from ..run.folder import RunFolder
from ..run.lock import take_lock
from ..system.progress import Progress
from ..system.stopping import stop_if_asked
from ..system.values import load_value, name_of, of_name, save_value
from .workers import code_identity, work_here

T = TypeVar("T")
R = TypeVar("R")
_TASKS = ".tasks"
_READY = "ready.json"
BETWEEN_LOOKS = 0.5
"""Seconds."""
TASK_MODULES = (
    "msgs_slam.pipelines.frames.tasks",
    "msgs_slam.pipelines.proxy.tasks",
    "msgs_slam.pipelines.mapping.submap_tasks",
    "msgs_slam.pipelines.export.tasks",
)
"""Where functions that do tasks are defined: a run from elsewhere could name any function of the program."""


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
    """Whoever looks into the run's folder, and this process."""

    shard: Shard
    prepare: Callable[[str], Progress]
    threads: int

    @property
    def at_once(self) -> int:
        """Number of processes that may work at the same time."""
        return self.shard.count

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """Post the tasks, work on them here and elsewhere, and gather the results; see `TaskWorkers.each`."""
        posted = Posted.post(work, tasks, folder, self.threads)
        while missing := posted.missing():
            stop_if_asked()
            if not posted.do_one(self.shard, self.prepare) and missing == posted.missing():
                time.sleep(BETWEEN_LOOKS)
        found = [load_value(posted.done(n)) for n in range(len(tasks))]
        posted.withdraw()
        return found


@dataclass(frozen=True)
class Posted:
    """Tasks of one kind in a folder of the run: NNNN.npz each, NNNN.lock which somebody holds who works on it, and
    NNNN.done.npz what it has returned. They can be taken up while ready.json is there."""

    folder: Path

    @staticmethod
    def post(work: Callable[..., Any], tasks: Sequence[Any], folder: Path, threads: int) -> Posted:
        """The tasks of a stage whose unfinished folder that is."""
        told = hashlib.sha256(f"{folder.name} {work.__name__} {time.time_ns()}".encode()).hexdigest()[:12]
        posted = Posted(folder.parent / _TASKS / f"{work.__name__}-{told}")
        for number, task in enumerate(tasks):
            save_value(posted.task(number), task)
        about = {"work": name_of(work), "folder": folder.name, "threads": threads, "count": len(tasks)}
        write_json(posted.folder / _READY, {**about, "code": code_identity()})
        return posted

    def task(self, number: int) -> Path:
        """Path of the file that holds a task."""
        return self.folder / f"{number:04d}.npz"

    def done(self, number: int) -> Path:
        """Path of the file that holds what a task has returned."""
        return self.folder / f"{number:04d}.done.npz"

    def missing(self) -> list[int]:
        """Tasks that are not done."""
        return [n for n in range(self._about()["count"]) if not self.done(n).exists()]

    def _about(self) -> dict[str, Any]:
        return read_json(self.folder / _READY)

    def do_one(self, shard: Shard, prepare: Callable[[str], Progress]) -> bool:
        """Do one that nobody works on, of the shard's own first; whether there was any."""
        try:
            about = self._about()
        except InputError:  # withdrawn
            return False
        own = set(range(shard.index, about["count"], shard.count))
        numbers = sorted(range(about["count"]), key=lambda n: (n not in own, (n - shard.index) % about["count"]))
        return any(self._do(n, about, prepare) for n in numbers)

    def _do(self, number: int, about: dict[str, Any], prepare: Callable[[str], Progress]) -> bool:
        try:
            stream = (self.folder / f"{number:04d}.lock").open("ab")
        except FileNotFoundError:  # withdrawn
            return False
        with stream:
            if self.done(number).exists() or not take_lock(stream):
                return False
            if self.done(number).exists() or not (self.folder / _READY).exists():
                return False
            self._do_locked(number, about, prepare)
        return True

    def _do_locked(self, number: int, about: dict[str, Any], prepare: Callable[[str], Progress]) -> None:
        """What the work raises is the work's own, a file that is missing above all: nobody tries again for it."""
        if about["work"].partition(":")[0] not in TASK_MODULES:
            raise InputError(
                f"{self.folder / _READY}: {about['work']} is not a task of this program. Delete {self.folder}"
            )
        work, folder = of_name(about["work"]), self.folder.parents[1] / about["folder"]
        name, task = f"{work.__name__} {number + 1}", load_value(self.task(number))
        refused, value = work_here(work, task, name, prepare, folder, about["threads"], about["code"])
        if refused:
            raise RecoverableError(f"{name}: {refused}")
        with own_temporaries():  # on a disk without locks another process may do the same task
            save_value(self.done(number), value)

    def withdraw(self) -> None:
        """Nobody takes one up any more; waits for those who are at one."""
        with suppress(FileNotFoundError):
            (self.folder / _READY).unlink()
        for lock in sorted(self.folder.glob("*.lock")):
            with lock.open("ab") as stream:
                while not take_lock(stream):
                    stop_if_asked()
                    time.sleep(BETWEEN_LOOKS)
        for _ in range(20):  # whoever looks in at this moment may leave a lock; a disk may be slow to let go of one
            shutil.rmtree(self.folder, ignore_errors=True)
            if not self.folder.exists():
                break
            time.sleep(BETWEEN_LOOKS / 5)
        with suppress(OSError):
            self.folder.parent.rmdir()


def posted_in(run: RunFolder) -> Iterator[Posted]:
    found: list[Path] = []
    with suppress(FileNotFoundError):  # nothing is posted, or no longer
        found = sorted((run.root / _TASKS).iterdir())
    yield from map(Posted, found)


def withdraw_all(run: RunFolder) -> None:
    """Withdraw the tasks that an earlier leader has posted."""
    for posted in posted_in(run):
        posted.withdraw()
