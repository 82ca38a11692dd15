"""`reconstruct --engine ray` on Ray's own test cluster: the same bytes as one process, whatever node is killed.

    python tests/benchmarks/cluster.py --work DIR --nodes 2                       the same bytes as in one process?
    python tests/benchmarks/cluster.py --work DIR --nodes 2 --kills 8 --seed 0    nodes killed in every stage
    python tests/benchmarks/cluster.py --work DIR --nodes 2 --kill-head proxy     all of Ray killed once, then resume
    python tests/benchmarks/cluster.py --work DIR --nodes 1 --bad folder          a node that is of no use, then resume

Every node is a process of this machine with one CPU; the head has none, so that tasks run on the others. A killed node
is replaced at once. Needs the extra [cluster].
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

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
os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112  with its 15 anything else starves the tasks

from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.evaluation.write import unpack_demo_clip

WITH_TASKS = {
    "frames": "snapshot",
    "proxy": "snapshot",
    "mapping": "snapshot",
    "export": "snapshot/mesh",
}
"""Stages that submit tasks, and what of their unfinished folder is there once they have."""
SETTINGS = (
    "run.threads=1", "frames.rate=4", "frames.max_features=600", "proxy.stereo_side=96",
    "mapping.passes=1", "mapping.min_iterations=20", "mapping.max_side=160", "mapping.submap=6", "export.voxel=0.03",
)  # fmt: skip
BETWEEN_KILLS = (0.05, 0.6)
"""Seconds."""
BAD = {
    "folder": "mount -t tmpfs none {run}",
    "disk": "mount -t tmpfs -o size=60k none {run}/proxy.partial",
    "program": "mount -t tmpfs none {root}",
}
"""What makes a node bad, in a shell of its own mount and host names (unshare, for which one has to be root)."""
EXPORTS = {"trajectory": "export/trajectory.txt", "map": "export/point_cloud.ply", "mesh": "export/mesh.ply"}


def msgs_slam(*arguments: object) -> list[str]:
    """The command, for subprocess."""
    return [sys.executable, "-m", "msgs_slam", *map(str, arguments)]


def beginning(video: Path, run: Path) -> list[str]:
    """The command that reconstructs the clip."""
    return msgs_slam("reconstruct", video, "--out", run, *(part for text in SETTINGS for part in ("--set", text)))


def contents(run: Path) -> dict[str, str]:
    """Digest of every file that the stages have left."""
    files = (p for stage in STAGES for p in (run / stage).rglob("*") if p.is_file())
    return {str(p.relative_to(run)): file_sha256(p) for p in files}


def add_bad_node(cluster: Any, bad: str, run: Path) -> subprocess.Popen[bytes]:
    """A node called node-b that does not see the run, has no room in it, or not the program."""
    ray = Path(sys.executable).with_name("ray")
    spoil = BAD[bad].format(run=run.resolve(), root=ROOT)
    script = f"hostname node-b && {spoil} && cd / && exec {ray} start --address={cluster.address} --num-cpus=1 --block"
    return subprocess.Popen(["unshare", "-m", "-u", "sh", "-c", script], stdout=subprocess.DEVNULL)


def by_cluster(
    cluster: Any, video: Path, run: Path, kills: int, rng: random.Random, kill_head: str, bad: str
) -> dict[str, Any]:  # fmt: skip
    """One reconstruction while nodes are killed, in each stage as long as there are kills left; how it
    ended. A `bad` node joins in `proxy`."""
    command = [*beginning(video, run), "--engine", "ray", "--address", cluster.address]
    log, killed, due = run.with_suffix(".log"), dict.fromkeys(WITH_TASKS, 0), 0.0
    with log.open("wb") as stream:
        process = subprocess.Popen(command, cwd=ROOT, stdout=stream, stderr=stream)
    spoilt = None
    while process.poll() is None:
        time.sleep(0.1)
        stage = next((s for s, begun in WITH_TASKS.items() if (run / f"{s}.partial" / begun).exists()), "")
        if bad and stage == "proxy" and spoilt is None:
            spoilt = add_bad_node(cluster, bad, run)
        if not stage or time.monotonic() < due:
            due = due if stage else time.monotonic() + rng.uniform(*BETWEEN_KILLS)
            continue
        due = time.monotonic() + rng.uniform(*BETWEEN_KILLS)
        if stage == kill_head:
            killed["head"] = 1
            cluster.shutdown()
            break
        if killed[stage] < -(-kills // len(WITH_TASKS)):
            cluster.remove_node(
                rng.choice(sorted(cluster.worker_nodes, key=lambda node: node.node_id)), allow_graceful=False
            )
            killed[stage] += 1
            cluster.add_node(num_cpus=1)
    code = process.wait()
    if spoilt is not None:
        spoilt.terminate()
        spoilt.wait()
    return {"exit code": code, "killed": killed}


def main() -> None:
    """Print what was done and which files differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--nodes", type=int, default=2)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--kill-head", default="", choices=("", *WITH_TASKS))
    parser.add_argument("--bad", default="", choices=("", *BAD))
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    from ray.cluster_utils import Cluster

    video, _ = unpack_demo_clip(arguments.work)
    whole, shared = (arguments.work / f"{name}.msgs" for name in ("whole", "cluster"))
    subprocess.run([*beginning(video, whole), "-q"], check=True, cwd=ROOT)
    shutil.rmtree(shared, ignore_errors=True)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(arguments.nodes):
        cluster.add_node(num_cpus=1)
    started = time.monotonic()
    rng = random.Random(arguments.seed)
    told = by_cluster(cluster, video, shared, arguments.kills, rng, arguments.kill_head, arguments.bad)
    if told["exit code"]:
        print(shared.with_suffix(".log").read_text(errors="replace")[-1500:])
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
