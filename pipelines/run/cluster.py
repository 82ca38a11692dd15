"""Tasks in other processes: one after the other on this machine, or side by side on the nodes of a Ray cluster.

What is given to a task and what it returns goes through Ray; what it reads of the run and leaves there are files on a
disk that all nodes have under the same path. A task leaves each file whole or not at all, and one that ran half or
twice leaves the same: so Ray may begin it again where its process or its node is lost.
"""

import functools
import multiprocessing
import os
import platform
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from ...formats.atomic import unique_temp_names
from ...formats.errors import InputError, RecoverableError, install_extra
from ..system.identity import package_digest
from ..system.progress import Progress, SilentProgress, Stopped, is_asked, log, soft_stop, stop_if_asked
from ..system.threads import limit_threads

T = TypeVar("T")
R = TypeVar("R")
RETRIES = 3
"""How often Ray begins a task again whose process or node is lost."""
_STARTS = 2
"""How often a process of this machine is started when it is lost."""
_ANSWERS_WITHIN, _ENDS_WITHIN = 5.0, 20.0
"""Seconds: for an address to answer, for cancelled tasks to end by themselves."""
_COMPUTE = ("torch", "numpy", "scipy", "pycolmap", "numba", "opencv-python-headless", "scikit-image")
_GO_ON = "What the tasks have done is kept: the same command continues, with --engine ray or without"


class RayCluster:
    """The nodes of the cluster at `address` (host:port, or auto), else this machine as one node.

    Args:
        address: of the cluster's head; "" starts Ray on this machine.
        threads: CPU threads of each task, 0 for as many as the smallest node has: the same on every node, or the
            results would differ.
        gpus: GPUs of each task.
        show_prints: whether what tasks print is shown.

    Raises InputError where Ray is not installed, none answers, or no node has room for a task.
    """

    def __init__(self, address: str = "", threads: int = 0, gpus: int = 0, show_prints: bool = True) -> None:
        self._ray = _import_ray()
        if address not in ("", "auto"):
            _require_answer(address)
        try:
            self._ray.init(address or "local", log_to_driver=show_prints, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(
                f"no Ray cluster could be joined at {address or 'this machine'} ({str(error)[:300]}). Start one with "
                "`ray start --head`, with the same versions of Python and Ray on every node, or omit --address"
            ) from error
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        cpus = [int(node.get("CPU", 0)) for node in nodes if node.get("GPU", 0) >= gpus]
        self.threads = threads or min((count for count in cpus if count), default=1)
        self.at_once = sum(count // self.threads for count in cpus)
        if not self.at_once:  # Ray would wait for such a node for good
            self.close()
            raise InputError(
                f"no node of the Ray cluster has {self.threads} CPUs and {gpus} GPUs: --set run.threads=N and --device "
                "say how many a task takes"
            )
        self._task = self._ray.remote(_run_task).options(
            num_cpus=self.threads, num_gpus=gpus, max_retries=RETRIES, retry_exceptions=False
        )

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path, progress: Progress) -> list[R]:
        """See `TaskWorkers.each`. Raises RecoverableError where a task was refused or lost."""
        found: dict[int, R] = {}
        label = getattr(work, "__name__", "tasks").replace("_", " ")
        for number, result in progress.track(self.run(work, tasks, [folder]), label, len(tasks)):
            found[number] = result()
        return [found[number] for number in range(len(tasks))]

    def run(
        self, work: Callable[[T, Progress], R], tasks: Sequence[T], folders: Sequence[Path]
    ) -> Iterator[tuple[int, Callable[[], R]]]:
        """Yield the number of each task as it ends, and what returns its result, or raises RecoverableError where it
        was refused or lost; `folders` are those that a node has to see."""
        given = (folders, self.threads, installation())
        waiting = {self._task.remote(work, task, *given): number for number, task in enumerate(tasks)}
        try:
            while waiting:
                stop_if_asked()
                for ref in self._ray.wait(list(waiting), timeout=0.5)[0]:
                    yield waiting.pop(ref), functools.partial(self._result, ref)
        finally:
            self._cancel(list(waiting))

    def _result(self, ref: Any) -> Any:
        errors = self._ray.exceptions
        try:
            return self._ray.get(ref)
        except errors.RayTaskError as error:
            if isinstance(error.cause, InputError):
                raise RecoverableError(f"{error.cause}. {_GO_ON}") from error
            if f"in {_run_task.__name__}" in str(error):
                raise  # a bug, with its traceback
            raise RecoverableError(
                f"on the node {error.ip}, which has no msgs-slam, or another version: {str(error.cause)[-300:]}\n"
                f"Install the same version on every node, in the Python of `ray start`. {_GO_ON}"
            ) from error
        except errors.RayError as error:
            reason = " ".join(str(error).split())[:300]
            raise RecoverableError(
                f"a task was lost {RETRIES + 1} times with its process or node, for want of memory perhaps: {reason}. "
                f"{_GO_ON}"
            ) from error

    def _cancel(self, refs: list[Any]) -> None:
        """End what still runs, softly at first."""
        for force in (False, True):
            for ref in refs:
                self._ray.cancel(ref, force=force)
            if refs:
                refs = self._ray.wait(refs, num_returns=len(refs), timeout=_ENDS_WITHIN)[1]

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _run_task(
    work: Callable[[T, Progress], R], task: T, folders: Sequence[Path], threads: int, wanted: dict[str, str]
) -> R:
    """Do a task in a process of a node. Raises InputError, with the node's name, where it cannot."""
    node, ours = platform.node(), installation()
    for name in wanted:
        if ours[name] != wanted[name]:
            raise InputError(
                f"the node {node} has another version of {name} ({ours[name][:12]}, not {wanted[name][:12]}), so that "
                "its results would differ: install the same on every node"
            )
    for folder in folders:
        if not folder.exists():
            raise InputError(
                f"the node {node} does not see {folder}: sources and runs must lie on a disk that all nodes have under "
                "the same path"
            )
    limit_threads(threads)
    with unique_temp_names():  # one that is taken for lost may still be at the same files
        try:
            return work(task, SilentProgress())
        except InputError as error:
            raise InputError(f"on the node {node}: {error}") from error


@functools.cache
def installation() -> dict[str, str]:
    """Versions of what results depend on: the program's sources and the libraries that compute."""
    found = {"msgs-slam": package_digest()}
    for name in _COMPUTE:
        try:
            found[name] = version(name).partition("+")[0]  # +cpu, +cu128: the device is a setting
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise InputError(f"--engine ray needs Ray on every node: {install_extra('cluster')}") from error
    return ray


def _require_answer(address: str) -> None:
    """Ray itself waits for minutes for an address where nothing answers."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"--address {address}: expected HOST:PORT, as `ray start --head` prints it, or auto")
    try:
        socket.create_connection((host, int(port)), timeout=_ANSWERS_WITHIN).close()
    except (OSError, OverflowError) as error:
        raise InputError(
            f"no Ray answers at {address} ({error}). Start one there with `ray start --head`, mind the firewall, or "
            "omit --address to use this machine alone"
        ) from error


def run_in_processes(
    work: Callable[[T, Progress], object], tasks: Sequence[T]
) -> Iterator[tuple[int, Callable[[], None]]]:
    """Call `work`, a function of a module's top level, on each task in a process of its own, one after the other.

    Yields the number of each task as its process ends, and what raises RecoverableError where that was lost twice
    (killed, out of memory). The first signal to stop is passed on to the process; one whose parent is gone stops.
    """
    for number, task in enumerate(tasks):
        for _ in range(_STARTS):
            stop_if_asked()
            code = _run_process(work, task)
            stop_if_asked()
            if code >= 0:
                break
            log.warning("task %d: its process was lost (%s)", number + 1, signal.Signals(-code).name)
        yield number, functools.partial(_require_ended, code)


def _require_ended(code: int) -> None:
    if code:
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        how = f"ended by {name}{', for want of memory perhaps' if name == 'SIGKILL' else ''}" if code < 0 else name
        raise RecoverableError(f"its process was lost: {how}")


def _run_process(work: Callable[[T, Progress], object], task: T) -> int:
    """The exit code of the process, negative where a signal ended it."""
    process = multiprocessing.get_context("spawn").Process(target=_in_child, args=(work, task), daemon=True)
    process.start()
    is_passed_on = False
    try:
        while process.exitcode is None:
            process.join(0.2)
            if is_asked() and not is_passed_on:
                process.terminate()
                is_passed_on = True
        return process.exitcode
    finally:
        process.kill()
        process.join()


def _in_child(work: Callable[[T, Progress], object], task: T) -> None:
    if hasattr(os, "setsid"):
        os.setsid()  # a terminal's Ctrl-C goes to all processes of a session, and the parent passes on what it means
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    try:
        with soft_stop(lambda number: None):
            work(task, SilentProgress())
    except Stopped as stopped:
        sys.exit(128 + stopped.number)


def _stop_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
