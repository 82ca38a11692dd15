"""`reconstruct --engine ray` on Ray's own test cluster: the same bytes as one process, whatever node is killed.

    python tests/benchmarks/cluster.py --work DIR --nodes 2                       the same bytes as in one process?
    python tests/benchmarks/cluster.py --work DIR --nodes 2 --kills 8 --seed 0    nodes killed in every stage
    python tests/benchmarks/cluster.py --work DIR --nodes 2 --kill-head proxy     all of Ray killed once, then resume

Every node is a process of this machine with one CPU; the head has none, so that tasks run on the others. A killed node
is replaced at once. Needs msgs-slam[cluster].
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = str(ROOT)  # of the nodes, as an installed program is found
os.environ["RAY_memory_monitor_refresh_ms"] = "0"  # noqa: SIM112  Ray writes it so

from pipelines.demo import unpack_demo_clip
from pipelines.run_folder_names import STAGES
from tests.benchmarks.shards import SETTINGS, begin, contents, msgs_slam

EXPORTS = {"trajectory": "export/trajectory.txt", "map": "export/point_cloud.ply", "mesh": "export/mesh.ply"}


def by_cluster(cluster: Any, run: Path, video: Path, kills: int, rng: random.Random, kill_head: str) -> dict[str, Any]:
    """One reconstruction while nodes are killed, in each stage as long as there are kills left; how it ended."""
    chosen = [part for setting in SETTINGS for part in ("--set", setting)]
    command = msgs_slam("reconstruct", video, "--out", run, "--engine", "ray", "--address", cluster.address, *chosen)
    log = run.with_suffix(".log").open("wb")
    process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    killed: dict[str, int] = {}
    while process.poll() is None:
        stage = next((s for s in STAGES if (run / f"{s}.partial").exists()), "")
        time.sleep(rng.uniform(0.5, 4))
        if stage == kill_head and stage and (run / f"{stage}.partial" / "snapshot").exists():
            killed["head"] = 1
            cluster.shutdown()
            break
        if stage and sum(killed.values()) < kills and killed.get(stage, 0) < -(-kills // len(STAGES)) + 1:
            cluster.remove_node(rng.choice(sorted(cluster.worker_nodes, key=id)), allow_graceful=False)
            killed[stage] = killed.get(stage, 0) + 1
            cluster.add_node(num_cpus=1)
    return {"exit code": process.wait(), "killed": killed}


def main() -> None:
    """Print what was done and which files differ."""
    from ray.cluster_utils import Cluster

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--nodes", type=int, default=2)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--kill-head", default="", choices=("", *STAGES))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    video, _ = unpack_demo_clip(arguments.work)
    whole, shared = arguments.work / "whole.msgs", arguments.work / "cluster.msgs"
    begin(video, whole, STAGES[-1])
    shutil.rmtree(shared, ignore_errors=True)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(arguments.nodes):
        cluster.add_node(num_cpus=1)
    started = time.monotonic()
    told = by_cluster(cluster, shared, video, arguments.kills, random.Random(arguments.seed), arguments.kill_head)
    if told["exit code"]:
        subprocess.run(msgs_slam("resume", shared), check=True, cwd=ROOT)
        told["resumed"] = True
    seconds, (one, many) = time.monotonic() - started, (contents(r) for r in (whole, shared))
    differing = sorted(name for name in one.keys() | many.keys() if one.get(name) != many.get(name))
    same = {name: one[file] == many.get(file) for name, file in EXPORTS.items()}
    told |= {"nodes": arguments.nodes, "seconds": round(seconds), "files": len(one), "differing": differing, **same}
    print(json.dumps(told), flush=True)
    if not arguments.kill_head:
        cluster.shutdown()
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
