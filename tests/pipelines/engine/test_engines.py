"""Calls here and in a Ray cluster: what comes back, what a lost process costs, how it stops."""

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
from msgs_slam.pipelines.engine import engines
from msgs_slam.pipelines.engine.engines import Call, Engine, LocalEngine, RayEngine
from msgs_slam.pipelines.system.stopping import Stopped, soft_stop

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra msgs-slam[cluster]")


@pytest.fixture(scope="module", params=["local", pytest.param("ray", marks=needs_ray)])
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    if request.param == "local":
        yield LocalEngine()
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        cluster = RayEngine()
        yield cluster
        cluster.close()


def test_what_is_returned_raised_and_lost_comes_back(engine: Engine, tmp_path: Path) -> None:
    """Each call costs itself only; a process that is lost is tried once more."""
    (tmp_path / "once").mkdir()
    (tmp_path / "always").mkdir()
    calls = [
        Call("two", engine_calls.double, (2,)),
        Call("raises", engine_calls.fail, (3,)),
        Call("dies once", engine_calls.die, (str(tmp_path / "once"), 1)),
        Call("dies", engine_calls.die, (str(tmp_path / "always"), 5)),
        Call("four", engine_calls.double, (4,)),
    ]
    ended = {e.call.name: e for e in engine.run(calls)}
    assert {n: e.value for n, e in ended.items() if not e.failure} == {"two": 4, "four": 8, "dies once": "after 1"}
    assert "ValueError: no 3" in ended["raises"].failure
    assert "engine_calls.py" in ended["raises"].failure
    assert "its process was lost 2 times" in ended["dies"].failure
    assert len(list((tmp_path / "always").iterdir())) == 2


def test_a_signal_ends_the_calls(engine: Engine, tmp_path: Path) -> None:
    marker = tmp_path / "begun"

    def interrupt() -> None:
        while not marker.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    started = time.monotonic()
    with pytest.raises(Stopped), soft_stop(lambda number: None):
        list(engine.run([Call("waits", engine_calls.wait, (str(marker),)), Call("two", engine_calls.double, (2,))]))
    thread.join()
    assert time.monotonic() - started < 25


@pytest.mark.skipif(sys.platform == "win32", reason="kills as Unix does")
def test_a_killed_parent_leaves_no_process_behind(tmp_path: Path) -> None:
    marker = tmp_path / "begun"
    code = (
        "import engine_calls\nfrom msgs_slam.pipelines.engine.engines import Call, LocalEngine\n"
        f"list(LocalEngine().run([Call('waits', engine_calls.wait, ({str(marker)!r},))]))\n"
    )
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    parent = subprocess.Popen([sys.executable, "-c", code], env=paths, stderr=subprocess.DEVNULL)
    while not marker.exists() or not marker.read_text():
        assert parent.poll() is None
        time.sleep(0.05)
    child = int(marker.read_text())
    parent.kill()
    parent.wait()
    for _ in range(400):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the child still works")


@needs_ray
def test_an_address_without_a_cluster_is_told_of_at_once() -> None:
    with pytest.raises(InputError, match=r"no Ray answers at 127\.0\.0\.1:1 .*\n?.*`ray start --head`"):
        RayEngine("127.0.0.1:1")
    with pytest.raises(InputError, match="expected HOST:PORT"):
        RayEngine("somewhere")


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'msgs-slam\[cluster\]'"):
        RayEngine()


class NotInstalled(OSError):
    """As Ray tells of what goes wrong before a function begins."""

    ip, cause = "10.0.0.7", ModuleNotFoundError("No module named 'msgs_slam'")


class LosingRay:
    """As much of Ray as an engine asks of it, on machines that go; a real cluster is what benchmarks/cluster.py has."""

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
            raise kinds[self.lost.pop(0)]("no pulse")
        return self.function(*ref[:-1])


@pytest.mark.parametrize(
    ("lost", "value", "failure"),
    [
        (["node"] * 5 + ["process"] + ["node"] * 5, 14, ""),
        (["process", "node", "process"], None, "its process was lost 2 times: no pulse"),
        (["node"] * 50, None, "its node was lost 50 times: no pulse"),
        (["node", "bare"], None, "on the node 10.0.0.7, which has no msgs-slam, or another version: No module named"),
    ],
)
def test_lost_nodes_are_no_fault_of_the_call(lost: list[str], value: int | None, failure: str) -> None:
    """A process that is lost may be lost again for the same reason; machines come and go."""
    engine, begun = object.__new__(RayEngine), len(lost) + (value is not None)
    engine._ray = LosingRay(lost)
    (ended,) = engine.run([Call("seven", engine_calls.double, (7,))])
    assert ended.value == value
    assert ended.failure.startswith(failure)
    assert bool(ended.failure) == bool(failure)
    assert engine._ray.begun == begun


def test_a_head_that_is_gone_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(LosingRay):
        def wait(self, refs: list[Any], timeout: float, num_returns: int = 1) -> tuple[list[Any], list[Any]]:
            return [], refs

        def cancel(self, ref: Any, force: bool) -> None:
            pass

    monkeypatch.setattr(engines, "_BETWEEN_LOOKS", 0.0)
    monkeypatch.setattr(engines, "_HEAD_WITHIN", 0.1)
    engine = object.__new__(RayEngine)
    engine._ray = Silent([])
    with pytest.raises(
        RecoverableError, match=r"the head of the Ray cluster has gone: no Ray answers at 127\.0\.0\.1:1"
    ):
        list(engine.run([Call("seven", engine_calls.double, (7,))]))
    engine._ray = LosingRay(["here"])
    with pytest.raises(RecoverableError, match=r"Ray on this machine \(.*\) has ended.*`msgs-slam resume RUN`"):
        list(engine.run([Call("seven", engine_calls.double, (7,))]))


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
            RayEngine(f"127.0.0.1:{server.getsockname()[1]}")
        thread.join()
