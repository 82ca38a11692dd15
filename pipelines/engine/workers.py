"""Workers for the tasks of one run, over a shared disk, where that is not this process alone."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ...formats.atomic import own_temporaries, watched_by
from ...formats.errors import InputError, RecoverableError
from ..run.journal import Journal
from ..run.names import STAGES
from ..system.identity import stage_file, stage_identity
from ..system.progress import Progress
from ..system.wording import quoted
from .engines import Call, Engine
from .threads import set_threads

T = TypeVar("T")
R = TypeVar("R")
_COMPUTE = ("torch", "numpy", "scipy", "pycolmap", "numba", "opencv-python-headless", "scikit-image")


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

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """Do `work` on every task, below `folder`, a stage's unfinished one; returns its results in order."""
        ...


@dataclass(frozen=True)
class Workers:
    """An engine. `prepare` sets logging up there and makes the progress of a named task; threads, gpus: what a task
    takes of its node; at_once: how many tasks may run at the same time."""

    engine: Engine
    prepare: Callable[[str], Progress]
    threads: int
    gpus: int = 0
    at_once: int = 1

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """Do `work` on every task, below `folder`, a stage's unfinished one; returns its results in order.

        Raises RecoverableError where a task was refused or lost; what the others have written stays.
        """
        code, kind = code_identity(), work.__name__
        names = [f"{kind} {n}" for n in range(1, len(tasks) + 1)]
        calls = [
            Call(name, work_here, (work, task, name, self.prepare, folder, self.threads, code), self.threads, self.gpus)
            for name, task in zip(names, tasks, strict=True)
        ]
        found: dict[str, R] = {}
        for ended in self.engine.run(calls):
            if ended.failure:
                raise RecoverableError(
                    f"{ended.call.name}: {ended.failure.rstrip()}\nWhat the other tasks have done is kept: run "
                    f"`msgs-slam resume {quoted(folder.parent)}`"
                )
            refused, found[ended.call.name] = ended.value
            if refused:
                raise RecoverableError(f"{ended.call.name}: {refused}")
        return [found[name] for name in names]


def work_here(
    work: Callable[[Any, Progress], Any], task: Any, name: str, prepare: Callable[[str], Progress], folder: Path,
    threads: int, code: str,
) -> tuple[str, Any]:  # fmt: skip
    """The task in this process, beside others that may write the same: (why it is refused or "", what it returns)."""
    progress = prepare(name)
    try:
        require_same_world([folder], code)
    except InputError as error:
        return str(error), None
    set_threads(threads)
    try:
        with watched_by(Journal(folder)), own_temporaries():
            return "", work(task, progress)
    except InputError as error:
        return f"on the node {platform.node()}: {error}", None


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
    stages = " ".join(stage_identity(name, stage_file(name)) for name in STAGES)
    program = hashlib.sha256(stages.encode()).hexdigest()
    found = {"msgs-slam": program, "Python": platform.python_version(), **{name: _version(name) for name in _COMPUTE}}
    return " ".join(f"{name}={value}" for name, value in found.items())


def _version(package: str) -> str:
    try:
        return version(package).partition("+")[0]  # +cpu, +cu128: the device is a setting
    except PackageNotFoundError:
        return "none"
