"""Engines that run independent calls: one after the other on this machine, or on the machines of a Ray cluster.

Either way a call has a process of its own. What it returns comes back; a bug's traceback comes back as text; a process
that is lost (killed, out of memory) costs its own call only, which is tried once more, and one whose machine is gone is
done elsewhere.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import signal
import socket
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

from ...formats.errors import InputError, RecoverableError
from ..system.progress import log
from ..system.stopping import Stopped, is_asked, soft_stop, stop_if_asked

TRIES, NODES = 2, 50
"""How often a call is begun when its processes are lost, and when its nodes are: machines come and go."""
_ANSWERS_WITHIN, _ENDS_WITHIN = 5.0, 20.0
"""Seconds: for an address to answer, for cancelled calls to end by themselves."""
_BETWEEN_LOOKS, _HEAD_WITHIN = 5.0, 30.0
"""Seconds from one look for Ray's head to the next, and after which it will not come back."""
_GO_ON = "What the tasks have done is kept: run `msgs-slam resume RUN`, with --engine ray once it is back, or without"
_SETTINGS = b"\x04"
_HTTP2 = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + _SETTINGS + bytes(5)
"""How gRPC, which Ray speaks, begins a connection, and the kind of frame it begins to answer with (RFC 9113, 3.4)."""


@dataclass(frozen=True)
class Call:
    """`function`, of a module's top level, with plain `arguments`: both travel. cpus, gpus: what it takes of a node."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    cpus: int = 1
    gpus: int = 0


@dataclass(frozen=True)
class Ended:
    """value: what the call returned; failure: why it did not, "" where it did."""

    call: Call
    value: Any
    failure: str = ""


class Engine(Protocol):
    """Runs calls and hands each out when it has ended, in any order. Raises Stopped where a signal asks for it."""

    def run(self, calls: Sequence[Call]) -> Iterator[Ended]:
        """Yield each call as it has ended."""
        ...


class LocalEngine:
    """One call after the other, each with the whole machine."""

    def run(self, calls: Sequence[Call]) -> Iterator[Ended]:
        """Yield each call in order, as it has ended."""
        for call in calls:
            stop_if_asked()
            yield _in_own_process(call)


def _in_own_process(call: Call) -> Ended:
    context = multiprocessing.get_context("spawn")
    for _ in range(TRIES):
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_child, args=(sender, call), name=call.name)
        process.start()
        sender.close()
        try:
            kind, value = _answer(process, receiver)
        finally:
            process.kill()
            process.join()
        if kind == "stopped":
            stop_if_asked()
            raise Stopped(value)
        if kind != "lost":
            return Ended(call, value) if kind == "value" else Ended(call, None, value)
        log.warning("%s: its process was lost (%s)", call.name, reason := _how_it_ended(process.exitcode))
    return Ended(call, None, f"its process was lost {TRIES} times: {reason}")


def _answer(process: Any, receiver: Connection) -> tuple[str, Any]:
    """What the child has sent; ("lost", None) where it ended without a word. A signal to stop is passed on to it."""
    told = False
    while True:
        if is_asked() and not told:
            process.terminate()
            told = True
        try:
            if receiver.poll(0.2):
                return receiver.recv()
        except EOFError:
            process.join()
            return "lost", None


def _child(sender: Connection, call: Call) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent passes on what it means
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with soft_stop(lambda number: None):
            sender.send(("value", call.function(*call.arguments)))
    except Stopped as stopped:
        sender.send(("stopped", stopped.number))
    except Exception:
        sender.send(("failure", traceback.format_exc()))


def _end_with_parent() -> None:
    """A parent that is killed passes nothing on."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _how_it_ended(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"ended by {name}" + (", for want of memory perhaps" if name == "SIGKILL" else "")
    return f"exit code {exitcode}"


class RayEngine:
    """Tasks of a Ray cluster: of the one at `address` (host:port, or auto), else of one on this machine alone.

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

    @property
    def smallest_node(self) -> int:
        """CPUs that every node has."""
        nodes = [n["Resources"].get("CPU", 0) for n in self._ray.nodes() if n["Alive"]]
        return max(int(min((c for c in nodes if c >= 1), default=1)), 1)

    def room(self, cpus: int) -> int:
        """Count the calls of so many CPUs for which there is room."""
        return max(sum(int(n["Resources"].get("CPU", 0)) // cpus for n in self._ray.nodes() if n["Alive"]), 1)

    def run(self, calls: Sequence[Call]) -> Iterator[Ended]:
        """Yield each call as it ends, whatever the order."""
        task = self._ray.remote(_on_node)  # once: it is sent to the head, which may be gone later
        waiting = {_begin(task, c): c for c in calls}
        lost: Counter[tuple[str, str]] = Counter()
        looks = self._head_is_there()
        try:
            while waiting:
                stop_if_asked()
                next(looks)
                for ref in self._ray.wait(list(waiting), timeout=0.5)[0]:
                    call = waiting.pop(ref)
                    ended, kind, why = self._ended(ref, call)
                    if ended is None:
                        lost[call.name, kind] += 1
                        if lost[call.name, kind] < {"process": TRIES, "node": NODES}[kind]:
                            log.warning("%s: its %s was lost, it is begun again (%s)", call.name, kind, why)
                            waiting[_begin(task, call)] = call
                            continue
                        ended = Ended(call, None, f"its {kind} was lost {lost[call.name, kind]} times: {why}")
                    yield ended
        finally:
            self._cancel(list(waiting))

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

    def _ended(self, ref: Any, call: Call) -> tuple[Ended | None, str, str]:
        """None where a process or a node was lost, which of them, and Ray's reason."""
        try:
            kind, value = self._ray.get(ref)
        except self._ray.exceptions.RayTaskError as error:  # before `_on_node` could begin
            return Ended(call, None, (
                f"on the node {error.ip}, which has no msgs-slam, or another version: {str(error.cause)[-300:]}\n"
                "Install the same msgs-slam[cluster] on every node, in the Python that `ray start` runs in"
            )), "", ""  # fmt: skip
        except self._ray.exceptions.LocalRayletDiedError as error:
            raise RecoverableError(f"Ray on this machine ({platform.node()}) has ended. {_GO_ON}") from error
        except self._ray.exceptions.RayError as error:
            which = "node" if isinstance(error, self._ray.exceptions.NodeDiedError) else "process"
            return None, which, " ".join(str(error).split())[:300]
        return Ended(call, value) if kind == "value" else Ended(call, None, value), "", ""

    def _cancel(self, refs: list[Any]) -> None:
        for force in (False, True):
            for ref in refs:
                self._ray.cancel(ref, force=force)
            if refs:
                refs = self._ray.wait(refs, num_returns=len(refs), timeout=_ENDS_WITHIN)[1]

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def _begin(task: Any, call: Call) -> Any:
    options = {"name": call.name, "num_cpus": call.cpus, "num_gpus": call.gpus, "max_retries": 0}
    return task.options(**options).remote(call.function, call.arguments)


def _on_node(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, Any]:
    try:
        return "value", function(*arguments)
    except Exception:
        return "failure", f"on the node {platform.node()}:\n{traceback.format_exc()}"


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise InputError("--engine ray needs Ray: pip install 'msgs-slam[cluster]', on every node") from error
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
