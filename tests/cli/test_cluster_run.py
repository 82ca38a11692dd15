"""`reconstruct --engine ray` on two nodes of which one is lost: the bytes of one process."""

import importlib.util
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cli_runs import QUICK, FinishedRun, invoke
from test_kill_and_resume import digests

from msgs_slam.pipelines.run.folder import RunFolder
from tests.ray_nodes import two_nodes

SUBMAPS = ("--set", "mapping.submap=5")


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")
def test_two_nodes_of_which_one_is_lost_leave_what_one_process_does(
    finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    alone, shared = copied_run("alone.msgs"), tmp_path / "shared.msgs"
    shutil.rmtree(alone / "export")  # things keep the numbers that an earlier export gave them
    assert invoke("resume", alone, *SUBMAPS, "-q").exit_code == 0
    assert RunFolder(alone).records["mapping"].figures["submaps"] == 3

    killed: list[str] = []

    def kill_a_node(cluster: Any, node: Any) -> None:
        while not list((shared / "mapping.partial").glob("snapshot/**/*.safetensors")):
            if (shared / "mapping").exists():
                return
            time.sleep(0.02)
        killed.append(str(node))
        cluster.remove_node(node, allow_graceful=False)

    settings = [x for s in QUICK for x in ("--set", s)]
    with two_nodes() as (cluster, node):
        thread = threading.Thread(target=kill_a_node, args=(cluster, node), daemon=True)
        thread.start()
        ended = invoke(
            "reconstruct", finished_run.video, "--out", shared, *settings, *SUBMAPS,
            "--engine", "ray", "--address", cluster.address,
        )  # fmt: skip
        thread.join(timeout=5)
    assert ended.exit_code == 0, ended.stderr
    assert killed
    assert digests(shared) == digests(alone)
