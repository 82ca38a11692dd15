"""Processes here and in a Ray cluster: how they end, what a lost one costs, how they stop."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import engine_calls
import pytest

from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.pipelines.engine import placement, tasks
from msgs_slam.pipelines.engine.placement import ClusterWorkers, Command, LocalPlacement, Placement, RayCluster
from msgs_slam.pipelines.engine.tasks import Shard, boards_in
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.progress import Stopped, soft_stop

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")


@pytest.fixture(scope="module", params=["local", pytest.param("ray", marks=needs_ray)])
def somewhere(request: pytest.FixtureRequest) -> Iterator[Placement]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        if request.param == "local":
            yield LocalPlacement()
            return
        cluster = RayCluster()
        yield cluster
        cluster.close()


def command(name: str, *words: object) -> Command:
    return Command(name, ("placed_calls", *map(str, words)))


def test_a_failure_or_a_lost_process_costs_itself_only(somewhere: Placement, tmp_path: Path) -> None:
    """A process that is lost is tried once more."""
    for name in ("never", "once", "always"):
        (tmp_path / name).mkdir()
    commands = [
        command("lives", "die", tmp_path / "never", 0),
        command("raises", "fail", 3),
        command("dies once", "die", tmp_path / "once", 1),
        command("dies", "die", tmp_path / "always", 5),
    ]
    ended = {result.command.name: result for result in somewhere.run(commands)}
    assert {name for name, result in ended.items() if not result.failure} == {"lives", "dies once"}
    assert ended["raises"].is_reported
    assert ("exit code 1" if isinstance(somewhere, LocalPlacement) else "ValueError: no 3") in ended["raises"].failure
    assert "its process was lost 2 times: ended by SIGKILL" in ended["dies"].failure
    assert not ended["dies"].is_reported
    assert [len(list((tmp_path / name).iterdir())) for name in ("never", "once", "always")] == [1, 2, 2]


def test_a_signal_ends_the_processes(somewhere: Placement, tmp_path: Path) -> None:
    marker = tmp_path / "begun"

    def interrupt() -> None:
        while not marker.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    thread.start()
    started = time.monotonic()
    try:
        with pytest.raises(Stopped), soft_stop(lambda number: None):
            list(somewhere.run([command("waits", "wait", marker), command("raises", "fail", 1)]))
    finally:
        signal.signal(signal.SIGINT, before)
    thread.join()
    assert time.monotonic() - started < 25
    require_gone(int(marker.read_text()))


def require_gone(process: int) -> None:
    for _ in range(400):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the child still works")


def test_a_killed_parent_leaves_no_process_behind(tmp_path: Path) -> None:
    marker = tmp_path / "begun"
    code = (
        "from msgs_slam.pipelines.engine.placement import Command, LocalPlacement\n"
        f"list(LocalPlacement().run([Command('waits', ('placed_calls', 'wait', {str(marker)!r}))]))\n"
    )
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    parent = subprocess.Popen([sys.executable, "-c", code], env=paths, stderr=subprocess.DEVNULL)
    while not marker.exists() or not marker.read_text():
        assert parent.poll() is None
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    require_gone(int(marker.read_text()))


class Placed:
    """As much of a cluster as its workers ask for: each polled takes a task, or has failed."""

    def __init__(self, run: Path, failure: str = "") -> None:
        self.run, self.failure, self.begun = RunFolder(run), failure, []  # type: ignore[var-annotated]

    @property
    def is_idle(self) -> bool:
        return not self.begun

    def begin(self, command: Command) -> None:
        self.begun.append(command)

    def poll(self) -> list[placement.CommandResult]:
        if self.failure:
            return [placement.CommandResult(self.begun[0], self.failure)]
        for board in boards_in(self.run):
            board.do_one(Shard(), engine_calls.silent)
        return []


def test_a_cluster_takes_the_tasks_of_a_run_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "name_of", lambda work: work.__name__)
    monkeypatch.setattr(tasks, "of_name", lambda name: getattr(engine_calls, name))
    monkeypatch.setattr(tasks, "TASK_MODULES", ("engine_calls",))
    (folder := tmp_path / "proxy.partial").mkdir()
    workers = ClusterWorkers(Placed(tmp_path), 4, 1, 2, ("-v",))  # type: ignore[arg-type]
    assert workers.each(engine_calls.halve, [6, 2], folder) == [3, 1]
    assert workers.each(engine_calls.halve, [8], folder) == [4]
    assert [(c.name, c.cpus, c.gpus, c.words) for c in workers.cluster.begun] == [  # type: ignore[attr-defined]
        (f"worker {n + 1}", 4, 1, ("msgs_slam", "work", str(tmp_path), "--shard", f"{n}/2", "--placed", "-v"))
        for n in range(2)
    ]
    refused = ClusterWorkers(Placed(tmp_path, "on the node b: the disk is full"), 1, 0, 1)  # type: ignore[arg-type]
    with pytest.raises(RecoverableError, match=r"worker 1: on the node b: the disk is full\n.*`msgs-slam resume "):
        refused.each(engine_calls.halve, [8], folder)


@needs_ray
def test_an_address_without_a_cluster_is_told_of_at_once() -> None:
    with pytest.raises(InputError, match=r"no Ray answers at 127\.0\.0\.1:1 .*\n?.*`ray start --head`"):
        RayCluster("127.0.0.1:1")
    with pytest.raises(InputError, match="expected HOST:PORT"):
        RayCluster("somewhere")


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"-m pip install 'ray>="):
        RayCluster()


class NotInstalled(OSError):
    """How Ray reports what goes wrong before a function begins."""

    ip, cause = "10.0.0.7", ModuleNotFoundError("No module named 'msgs_slam'")


class Refused(NotInstalled):
    """How Ray reports what the function raises."""

    cause = InputError("the node b does not see /x")  # type: ignore[assignment]


class LosingRay:
    """As much of Ray as a placement asks of it, on machines that go; benchmarks/cluster.py has a real cluster."""

    def __init__(self, lost: list[str]) -> None:
        self.lost, self.begun = lost, 0
        self.exceptions = SimpleNamespace(
            RayError=OSError, NodeDiedError=ConnectionError, RayTaskError=NotInstalled, LocalRayletDiedError=EOFError
        )

    def get_runtime_context(self) -> SimpleNamespace:
        return SimpleNamespace(gcs_address="127.0.0.1:1")

    def remote(self, function: Callable[..., Any]) -> LosingRay:
        self.function = function
        return self

    def options(self, **options: Any) -> SimpleNamespace:
        def begin(*arguments: Any) -> tuple[Any, ...]:
            self.begun += 1
            return *arguments, self.begun

        return SimpleNamespace(remote=begin)

    def wait(self, refs: list[Any], timeout: float) -> tuple[list[Any], list[Any]]:
        return refs[:1], refs[1:]

    def get(self, ref: tuple[Any, ...]) -> tuple[str, Any]:
        if self.lost:
            kinds = {"node": ConnectionError, "process": OSError, "bare": NotInstalled, "here": EOFError}
            raise {**kinds, "refused": Refused}[self.lost.pop(0)]("no pulse")
        return "node-7", 0, ""


@pytest.mark.parametrize(
    ("lost", "failure"),
    [
        (["node"] * 5 + ["process"] + ["node"] * 5, ""),
        (["process", "node", "process"], "its process was lost 2 times: no pulse"),
        (["node"] * 50, "its node was lost 50 times: no pulse"),
        (["node", "bare"], "on the node 10.0.0.7, which has no msgs-slam, or another version: No module named"),
        (["refused"], "the node b does not see /x"),
    ],
)
def test_lost_nodes_are_no_fault_of_the_command(lost: list[str], failure: str) -> None:
    """A process that is lost may be lost again for the same reason; machines come and go."""
    ray, begun = LosingRay(lost), len(lost) + (not failure)
    (result,) = cluster_of(ray).run([command("seven", "double", 7)])
    assert result.failure.startswith(failure)
    assert bool(result.failure) == bool(failure)
    assert ray.begun == begun


def cluster_of(ray: LosingRay) -> RayCluster:
    cluster = object.__new__(RayCluster)
    cluster._ray = ray
    cluster._prepare()
    return cluster


def test_a_head_that_is_gone_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(LosingRay):
        def wait(self, refs: list[Any], timeout: float, num_returns: int = 1) -> tuple[list[Any], list[Any]]:
            return [], refs

        def cancel(self, ref: Any, force: bool) -> None:
            pass

    monkeypatch.setattr(placement, "_BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(placement, "_HEAD_WITHIN", 0.1)
    with pytest.raises(
        RecoverableError, match=r"the head of the Ray cluster has gone: no Ray answers at 127\.0\.0\.1:1"
    ):
        list(cluster_of(Silent([])).run([command("seven", "double", 7)]))
    with pytest.raises(RecoverableError, match=r"Ray on this machine \(.*\) has ended.*`msgs-slam resume RUN`"):
        list(cluster_of(LosingRay(["here"])).run([command("seven", "double", 7)]))


@needs_ray
def test_an_address_where_another_program_listens_is_told_of_at_once() -> None:
    """Ray would wait for minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")
                connection.recv(100)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(InputError, match=r"no Ray answers at .* \(another program does, after 0 s\)"):
            RayCluster(f"127.0.0.1:{server.getsockname()[1]}")
        thread.join()
