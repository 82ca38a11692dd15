"""Tasks on two nodes of a Ray cluster: their results, what a lost process or node costs, how they are refused."""

from __future__ import annotations

import importlib.util
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.pipelines.run import cluster as cluster_module
from msgs_slam.pipelines.run.cluster import RETRIES, RayCluster
from msgs_slam.pipelines.system.progress import SilentProgress, Stopped, soft_stop
from tests.pipelines import task_calls
from tests.ray_nodes import two_nodes

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayCluster]:
    with two_nodes() as (nodes, _):
        found = RayCluster(nodes.address, threads=1)
        yield found
        found.close()


def each(cluster: RayCluster, work: Any, tasks: Any, folder: Path) -> list[Any]:
    return cluster.each(work, tasks, folder, SilentProgress())


@needs_ray
def test_results_come_in_order_whatever_is_lost(cluster: RayCluster, tmp_path: Path) -> None:
    assert (cluster.threads, cluster.at_once) == (1, 2)
    assert each(cluster, task_calls.halve, range(0, 20, 2), tmp_path) == list(range(10))
    for name in ("never", "once", "always"):
        (tmp_path / name).mkdir()
    assert each(cluster, task_calls.die, [(tmp_path / "never", 0), (tmp_path / "once", 1)], tmp_path) == [1, 2]
    with pytest.raises(RecoverableError, match=rf"lost {RETRIES + 1} times .* the same command continues"):
        each(cluster, task_calls.die, [(tmp_path / "always", 99)], tmp_path)
    assert len(list((tmp_path / "always").iterdir())) == RETRIES + 1


@needs_ray
def test_a_refused_task_names_the_node_and_a_bug_keeps_its_traceback(
    cluster: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RecoverableError, match=r"on the node .*: 3 is odd\. What the tasks have done is kept"):
        each(cluster, task_calls.halve, [3], tmp_path)
    with pytest.raises(ValueError, match="no 3"):
        each(cluster, task_calls.fail, [3], tmp_path)
    with pytest.raises(RecoverableError, match=r"the node .* does not see .*gone: .* under the same path"):
        each(cluster, task_calls.halve, [4], tmp_path / "gone")
    monkeypatch.setattr(cluster_module, "installation", lambda: {"torch": "1.0"})
    with pytest.raises(RecoverableError, match=r"has another version of torch \(.*, not 1\.0\)"):
        each(cluster, task_calls.halve, [4], tmp_path)


@needs_ray
def test_a_signal_ends_the_tasks(cluster: RayCluster, tmp_path: Path) -> None:
    marker = tmp_path / "begun"

    def interrupt() -> None:
        while not marker.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    thread = threading.Thread(target=interrupt)
    thread.start()
    started = time.monotonic()
    try:
        with pytest.raises(Stopped), soft_stop(lambda number: None):
            each(cluster, task_calls.wait, [marker], tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    thread.join()
    assert time.monotonic() - started < 25
    assert each(cluster, task_calls.halve, [4, 6], tmp_path) == [2, 3]


@needs_ray
def test_an_address_without_a_cluster_is_reported_at_once() -> None:
    with pytest.raises(InputError, match=r"no Ray answers at 127\.0\.0\.1:1 .*`ray start --head`"):
        RayCluster("127.0.0.1:1")
    with pytest.raises(InputError, match="expected HOST:PORT"):
        RayCluster("somewhere")


def test_tasks_that_no_node_has_room_for_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = [{"Alive": True, "Resources": {"CPU": 4.0}}, {"Alive": False, "Resources": {"CPU": 64.0, "GPU": 1.0}}]
    ray = SimpleNamespace(init=lambda *_, **more: None, nodes=lambda: nodes, shutdown=lambda: None)
    monkeypatch.setattr(cluster_module, "_import_ray", lambda: ray)
    for threads, gpus in ((8, 0), (0, 1)):
        with pytest.raises(InputError, match="no node of the Ray cluster has"):
            RayCluster(threads=threads, gpus=gpus)


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"-m pip install 'ray>="):
        RayCluster()
