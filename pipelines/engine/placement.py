"""Processes of this program, started on this machine one after the other or placed on the nodes of a Ray cluster.

A placed process runs a command of this program that works through files (`batch` on one recording, `work` on the tasks
of a run): nothing but its command line travels. A process that is lost (killed, out of memory) costs its own command
only, which is tried once more; one whose machine is gone is started elsewhere. Its standard input is a pipe that ends
with its parent: it stops softly then (`stop_with_parent`).
"""

import os
import platform
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol, TypeVar

from ...formats.errors import InputError, RecoverableError, install_extra
from ..system.progress import SIGNALS, Progress, Stopped, is_asked, log, stop_if_asked
from ..system.wording import quoted
from .tasks import TaskBoard, code_identity, require_same_world

T = TypeVar("T")
R = TypeVar("R")

TRIES, NODES = 2, 50
"""How often a command is started when its processes are lost, and when its nodes are: machines come and go."""
_ANSWERS_WITHIN, _ENDS_WITHIN = 5.0, 20.0
"""Seconds: for an address to answer, for cancelled commands to end by themselves."""
_BETWEEN_LOOKS, _HEAD_WITHIN = 5.0, 30.0
"""Seconds from one look for Ray's head to the next, and after which it will not come back."""
_TAIL_CHARACTERS = 3000
"""Of what a placed process has written on stderr."""
_REFUSED = (1, 2)
"""Exit codes of a command that has said why it failed."""
_GO_ON = "What the tasks have done is kept: run `msgs-slam resume RUN`, with --engine ray once it is back, or without"
_SETTINGS = b"\x04"
_HTTP2 = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + _SETTINGS + bytes(5)
"""How gRPC, which Ray speaks, begins a connection, and the kind of frame it begins to answer with (RFC 9113, 3.4)."""


@dataclass(frozen=True)
class Command:
    """A module to run, and its arguments. cpus, gpus: what it takes of a node; folders: what it needs to see there."""

    name: str
    words: tuple[str, ...]
    cpus: int = 1
    gpus: int = 0
    folders: tuple[Path, ...] = ()


@dataclass(frozen=True)
class CommandResult:
    """failure: why the command did not end well, "" where it did; is_reported: whether the process itself has
    reported it."""

    command: Command
    failure: str = ""
    is_reported: bool = False


class Placement(Protocol):
    """Runs commands and yields each when it has ended, in any order. Raises Stopped where a signal asks for it."""

    def run(self, commands: Sequence[Command]) -> Iterator[CommandResult]:
        """Yield each command as it has ended."""
        ...


def stop_with_parent() -> None:
    """Let this process stop softly when the one that started it is gone: its standard input ends then."""

    def wait() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


class LocalPlacement:
    """One command after the other, each with the whole machine."""

    def run(self, commands: Sequence[Command]) -> Iterator[CommandResult]:
        """Yield each command in order, as it has ended."""
        for command in commands:
            for _ in range(TRIES):
                stop_if_asked()
                code = run_process(command.words)
                if code in (0, *_REFUSED):
                    yield CommandResult(command, f"exit code {code}" if code else "", bool(code))
                    break
                stop_if_asked()
                if code - 128 in SIGNALS:
                    raise Stopped(code - 128)
                log.warning("%s: its process was lost (%s)", command.name, how_it_ended(code))
            else:
                yield CommandResult(command, f"its process was lost {TRIES} times: {how_it_ended(code)}")


def run_process(words: Sequence[str], on_line: Callable[[str], None] | None = None, grace: float = 0) -> int:
    """Run a module in a process to its end; the first signal to stop is passed on to it, and an exception here (a
    second signal) ends it.

    Args:
        words: its name and its arguments.
        on_line: is given each line that it writes on stderr; None lets it write on this process's.
        grace: seconds that it is left to end by itself after an exception, before it is killed.

    Returns:
        Its exit code, negative where a signal ended it.
    """
    # In a session of its own: a terminal's Ctrl-C goes to all processes, and the parent passes on what it means.
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        stdin=subprocess.PIPE, stderr=None if on_line is None else subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    reader = threading.Thread(target=_read_lines, args=(process.stderr, on_line), daemon=True)
    reader.start()
    passed_on = False
    try:
        while (code := _ended(process, 0.2)) is None:
            if is_asked() and not passed_on:
                process.terminate()
                passed_on = True
        reader.join(timeout=2.0)  # a child of it that still runs holds the other end
        return code
    finally:
        if grace and process.poll() is None:
            process.terminate()
            _ended(process, grace)
        process.kill()
        process.wait()


def _ended(process: subprocess.Popen[bytes], seconds: float) -> int | None:
    """The exit code; None where the process still runs after so many seconds."""
    with suppress(subprocess.TimeoutExpired):
        return process.wait(seconds)
    return None


def _read_lines(stream: IO[bytes] | None, on_line: Callable[[str], None] | None) -> None:
    if stream is not None and on_line is not None:
        for line in stream:
            on_line(line.decode("utf-8", errors="replace"))


def how_it_ended(code: int) -> str:
    """Say how a process ended, by its exit code."""
    if code < 0:
        name = signal.Signals(-code).name
        return f"ended by {name}" + (", for want of memory perhaps" if name == "SIGKILL" else "")
    return f"exit code {code}"


class RayCluster:
    """Places commands on the nodes of a Ray cluster: of the one at `address` (host:port, or auto), else of one on this
    machine alone.

    Raises InputError where Ray is not installed, or none answers.
    """

    def __init__(self, address: str = "") -> None:
        self._ray = _import_ray()
        if address not in ("", "auto"):
            _require_answer(address)
        try:
            self._ray.init(address or "local", log_to_driver=True, include_dashboard=False if not address else None)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(
                f"no Ray cluster could be joined at {address or 'this machine'} ({str(error)[:300]}). Start one with "
                "`ray start --head`, with the same versions of Python and Ray on every node, or omit --address"
            ) from error
        self._prepare()

    def _prepare(self) -> None:
        self._task = self._ray.remote(run_on_node)  # once: it is sent to the head, which may be gone later
        self._waiting: dict[Any, Command] = {}
        self._lost: Counter[tuple[str, str]] = Counter()
        self._looks = self._head_is_there()

    @property
    def smallest_node(self) -> int:
        """CPUs that every node has."""
        nodes = [n["Resources"].get("CPU", 0) for n in self._ray.nodes() if n["Alive"]]
        return max(int(min((c for c in nodes if c >= 1), default=1)), 1)

    def room(self, cpus: int) -> int:
        """Count the commands of so many CPUs for which there is room."""
        return max(sum(int(n["Resources"].get("CPU", 0)) // cpus for n in self._ray.nodes() if n["Alive"]), 1)

    @property
    def is_idle(self) -> bool:
        """Whether no command is placed."""
        return not self._waiting

    def begin(self, command: Command) -> None:
        """Place a command; `poll` says when it has ended."""
        options = {"name": command.name, "num_cpus": command.cpus, "num_gpus": command.gpus, "max_retries": 0}
        arguments = (command.words, command.folders, code_identity())
        self._waiting[self._task.options(**options).remote(*arguments)] = command

    def poll(self) -> list[CommandResult]:
        """Wait for half a second; returns the commands that have ended. Raises RecoverableError where Ray is gone."""
        next(self._looks)
        ready = self._ray.wait(list(self._waiting), timeout=0.5)[0]
        return [result for ref in ready if (result := self._result(ref, self._waiting.pop(ref))) is not None]

    def run(self, commands: Sequence[Command]) -> Iterator[CommandResult]:
        """Yield each command as it ends, whatever the order."""
        for command in commands:
            self.begin(command)
        try:
            while not self.is_idle:
                stop_if_asked()
                yield from self.poll()
        finally:
            self.cancel()

    def _head_is_there(self) -> Iterator[None]:
        """Look now and then, whenever asked for the next: Ray itself waits for its head for good. Raises
        RecoverableError where that has not answered several times."""
        address, seen = self._ray.get_runtime_context().gcs_address, time.monotonic()
        looked = seen
        while True:
            yield
            if time.monotonic() - looked < _BETWEEN_LOOKS:
                continue
            try:
                _require_answer(address)
                seen = time.monotonic()
            except InputError as error:
                if time.monotonic() - seen > _HEAD_WITHIN:
                    raise RecoverableError(f"the head of the Ray cluster has gone: {error}. {_GO_ON}") from error
            looked = time.monotonic()

    def _result(self, ref: Any, command: Command) -> CommandResult | None:
        """The result; None where a process or a node was lost and the command is placed again."""
        try:
            node, code, text = self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, InputError):
                return CommandResult(command, str(error.cause))
            return CommandResult(command, (  # `run_on_node` could not begin
                f"on the node {error.ip}, which has no msgs-slam, or another version: {str(error.cause)[-300:]}\n"
                "Install the same version, with the extra [cluster], on every node, in the Python of `ray start`"
            ))  # fmt: skip
        except self._ray.exceptions.LocalRayletDiedError as error:
            raise RecoverableError(f"Ray on this machine ({platform.node()}) has ended. {_GO_ON}") from error
        except self._ray.exceptions.RayError as error:
            kind = "node" if isinstance(error, self._ray.exceptions.NodeDiedError) else "process"
            return self._place_again(command, kind, " ".join(str(error).split())[:300])
        if code == 0:
            return CommandResult(command)
        if code in _REFUSED:
            return CommandResult(command, f"on the node {node}: {text.strip()}", is_reported=True)
        return self._place_again(command, "process", how_it_ended(code))

    def _place_again(self, command: Command, kind: str, reason: str) -> CommandResult | None:
        self._lost[command.name, kind] += 1
        if (count := self._lost[command.name, kind]) >= {"process": TRIES, "node": NODES}[kind]:
            return CommandResult(command, f"its {kind} was lost {count} times: {reason}")
        log.warning("%s: its %s was lost, it is begun again (%s)", command.name, kind, reason)
        self.begin(command)
        return None

    def cancel(self) -> None:
        """End the commands that are placed, softly at first."""
        refs = list(self._waiting)
        self._waiting.clear()
        for force in (False, True):
            for ref in refs:
                self._ray.cancel(ref, force=force)
            if refs:
                refs = self._ray.wait(refs, num_returns=len(refs), timeout=_ENDS_WITHIN)[1]

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self.cancel()
        self._ray.shutdown()


@dataclass(frozen=True)
class ClusterWorkers:
    """Processes of a Ray cluster that take the tasks of a run from its folder; this one only leads.

    Args:
        cluster: where they are placed, when the first task is published.
        threads: threads and CPUs of each.
        gpus: GPUs of each.
        at_once: their number.
        options: of the command `work`, beside its own.
    """

    cluster: RayCluster
    threads: int
    gpus: int
    at_once: int
    options: tuple[str, ...] = ()

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """See `TaskWorkers.each`. Raises RecoverableError where a process was refused or lost; what the others have
        written stays."""
        board, run = TaskBoard.publish(work, tasks, folder, self.threads), folder.parent
        for number in range(self.at_once if self.cluster.is_idle else 0):
            words = ("msgs_slam", "work", str(run), "--shard", f"{number}/{self.at_once}", "--placed", *self.options)
            self.cluster.begin(Command(f"worker {number + 1}", words, self.threads, self.gpus, (run,)))
        while board.missing():
            stop_if_asked()
            for result in self.cluster.poll():
                raise RecoverableError(
                    f"{result.command.name}: {result.failure.rstrip() or 'ended'}\nWhat the other tasks have done is "
                    f"kept: run `msgs-slam resume {quoted(run)}`"
                )
        return board.collect()


def run_on_node(words: Sequence[str], folders: Sequence[Path], code: str) -> tuple[str, int, str]:
    """Run a command in a process on this node; returns the node's name, the exit code and the end of its stderr.

    Raises InputError where the node sees no such folders or has other code than `code` (`code_identity`).
    """
    require_same_world(folders, code)
    tail = ""

    def pass_on(line: str) -> None:
        nonlocal tail
        tail = (tail + line)[-_TAIL_CHARACTERS:]
        print(line, end="", file=sys.stderr, flush=True)

    code_of_exit = run_process(words, pass_on, _ENDS_WITHIN / 2)
    return platform.node(), code_of_exit, tail


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        fix = install_extra("cluster")
        raise InputError(f"--engine ray needs Ray on every node: {fix}") from error
    return ray


def _require_answer(address: str) -> None:
    """Ray itself waits for minutes for an address where nobody is."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise InputError(f"--address {address}: expected HOST:PORT, as `ray start --head` prints it, or auto")
    started = time.monotonic()
    try:
        with socket.create_connection((host, int(port)), timeout=_ANSWERS_WITHIN) as connection:
            connection.sendall(_HTTP2)
            if connection.recv(9)[3:4] != _SETTINGS:
                raise OSError("another program does")
    except (OSError, OverflowError) as error:
        raise InputError(
            f"no Ray answers at {address} ({error}, after {time.monotonic() - started:.0f} s). Start one there with "
            "`ray start --head`, mind the firewall, or omit --address to use this machine alone"
        ) from error
