"""`reconstruct --engine ray` on two nodes of which one is lost: the bytes of one process."""

import importlib.util
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_runs import QUICK, FinishedRun, invoke
from test_kill_and_resume import digests

from msgs_slam.pipelines.run.folder import RunFolder, load_records

SUBMAPS = ("--set", "mapping.submap=5")


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")
def test_two_nodes_of_which_one_is_lost_leave_what_one_process_does(
    finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray.cluster_utils import Cluster

    alone, shared = copied_run("alone.msgs"), tmp_path / "shared.msgs"
    assert invoke("resume", alone, *SUBMAPS, "-q").exit_code == 0
    assert load_records(RunFolder(alone))["mapping"].figures["submaps"] == 3

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # with its 15 anything else starves the tasks
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    lost = cluster.add_node(num_cpus=1)
    killed: list[str] = []

    def kill_a_node() -> None:
        while not list((shared / "mapping.partial").glob("snapshot/**/*.safetensors")):
            if (shared / "mapping").exists():
                return
            time.sleep(0.02)
        killed.append(str(lost))
        cluster.remove_node(lost, allow_graceful=False)

    thread = threading.Thread(target=kill_a_node)
    thread.start()
    settings = [x for s in QUICK for x in ("--set", s)]
    try:
        ended = invoke(
            "reconstruct", finished_run.video, "--out", shared, *settings, *SUBMAPS,
            "--engine", "ray", "--address", cluster.address,
        )  # fmt: skip
    finally:
        thread.join(timeout=5)
        cluster.shutdown()
    assert ended.exit_code == 0, ended.stderr
    assert killed
    assert digests(shared) == digests(alone)
