"""Two workers of one core each against one: the tasks of a run on pinned nodes of Ray's own test cluster.

    python tests/benchmarks/efficiency.py --work DIR [--set SECTION.KEY=VALUE ...]

The clip of the demo's room until `mapping`, on one node and on two, each held to a core of its own, after the same was
done there once. Seconds in which each kind of task was done; the efficiency; what it would be if tasks took as
long on two nodes as on one (they are few, and not alike); and by how much longer they took. Needs msgs-slam[cluster].
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = str(ROOT)  # of the nodes, as an installed program is found

from msgs_cli.options import worker_setup
from pipelines.demo import unpack_demo_clip
from pipelines.engines import Call, Ended, Engine, RayEngine
from pipelines.progress import SilentProgress
from pipelines.reconstruct import resume
from pipelines.run_folder import RunFolder
from pipelines.workers import Workers
from tests.benchmarks.shards import SETTINGS, msgs_slam
from tests.benchmarks.task_graph import makespan

CORES = sorted(os.sched_getaffinity(0))


@dataclass
class Timed:
    """An engine, the seconds of each kind of call, and those between the ends of its calls."""

    engine: Engine
    seconds: dict[str, float] = field(default_factory=dict)
    each: dict[str, list[float]] = field(default_factory=dict)

    def run(self, calls: Sequence[Call]) -> Iterator[Ended]:
        """All of them."""
        kind, started = calls[0].name.rpartition(" ")[0], time.monotonic()
        ends = [started]
        for ended in self.engine.run(calls):
            ends.append(time.monotonic())
            yield ended
        self.seconds[kind] = ends[-1] - started
        self.each[kind] = [b - a for a, b in pairwise(ends)]


def with_nodes(count: int, first: Path, run: Path) -> Timed:
    """The run, which frames has been done of, on so many nodes: twice, for what a process does but once (compiled code
    is loaded) would weigh more in tasks as small as these than in those of a long recording."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for core in CORES[:count]:
        os.sched_setaffinity(0, {core})  # what is started now inherits it
        cluster.add_node(num_cpus=1)
    os.sched_setaffinity(0, CORES)
    engine = RayEngine(cluster.address)
    for _ in range(2):
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(first, run)
        timed = Timed(engine)
        workers = Workers(timed, worker_setup(True, False, True), 1, 0, 2)  # as many portions on one node as on two
        resume(RunFolder(run), SilentProgress(), None, "mapping", workers)
    engine.close()
    cluster.shutdown()
    return timed


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="SECTION.KEY=VALUE")
    given = parser.parse_args()
    video, _ = unpack_demo_clip(given.work)
    first, chosen = given.work / "frames.msgs", [p for s in (*SETTINGS, *given.settings) for p in ("--set", s)]
    subprocess.run(msgs_slam("reconstruct", video, "--out", first, "--until", "frames", *chosen), check=True, cwd=ROOT)
    one, two = (with_nodes(count, first, given.work / f"nodes_{count}.msgs") for count in (1, 2))
    print("| tasks | number | 1 node, s | 2 nodes, s | efficiency | of equal tasks | longer by |\n|" + " --- |" * 7)
    kinds = [*one.seconds, "all"]
    for found in (one, two):
        found.seconds["all"] = sum(found.seconds.values())
    ideal = {kind: makespan(each, 2) for kind, each in one.each.items()}
    ideal["all"] = sum(ideal.values())
    for kind in kinds:
        a, b, best = one.seconds[kind], two.seconds[kind], ideal[kind]
        count = len(one.each[kind]) if kind != "all" else sum(map(len, one.each.values()))
        print(f"| {kind} | {count} | {a:.1f} | {b:.1f} | {a / b / 2:.2f} | {a / best / 2:.2f} | {b / best - 1:.0%} |")


if __name__ == "__main__":
    main()
