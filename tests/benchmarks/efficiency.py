"""Two workers of one core each against one: the tasks of a run on pinned nodes of Ray's own test cluster.

    python tests/benchmarks/efficiency.py --work DIR [--set SECTION.KEY=VALUE ...]

The clip of the demo's room until `mapping`, on one node and on two, each held to a core of its own, after the same was
done there once. Seconds in which each kind of task was done; the efficiency; what it would be if tasks took as long on
two nodes as on one (they are few, and not alike); how many tasks which core did; their CPU seconds, and for which part
of their time they had the core. Needs msgs-slam[cluster] and a machine on which nothing else runs.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = str(ROOT)  # of the nodes, as an installed program is found

from msgs_slam.msgs_cli.output import Output
from msgs_slam.pipelines.demo import unpack_demo_clip
from msgs_slam.pipelines.engine.engines import Call, Ended, Engine, RayEngine
from msgs_slam.pipelines.engine.workers import Workers
from msgs_slam.pipelines.reconstruct import resume
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.benchmarks.shards import SETTINGS, msgs_slam
from tests.benchmarks.task_graph import makespan

CORES = sorted(os.sched_getaffinity(0))


@dataclass(frozen=True)
class Done:
    """One call: where (node, process, cores), its begin and end (of this machine's clock) and CPU time in seconds."""

    node: str
    pid: int
    cores: str
    began: float
    ended: float
    cpu: float

    @staticmethod
    def of(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[Any, Done]:
        """What the call returns, and how it was done."""
        import ray

        began, cpu = time.monotonic(), time.process_time()
        value = function(*arguments)
        node, cores = ray.get_runtime_context().get_node_id()[:6], sorted(os.sched_getaffinity(0))
        return value, Done(node, os.getpid(), str(cores), began, time.monotonic(), time.process_time() - cpu)


@dataclass
class Timed:
    """An engine, the seconds of each kind of call, and how each call was done."""

    engine: Engine
    seconds: dict[str, float] = field(default_factory=dict)
    done: dict[str, list[Done]] = field(default_factory=dict)

    def run(self, calls: Sequence[Call]) -> Iterator[Ended]:
        """All of them."""
        kind, started = calls[0].name.rpartition(" ")[0], time.monotonic()
        done = self.done[kind] = []
        recorded = [replace(c, function=Done.of, arguments=(c.function, c.arguments)) for c in calls]
        for ended in self.engine.run(recorded):
            value, how = ended.value
            done.append(how)
            yield replace(ended, value=value)
        self.seconds[kind] = time.monotonic() - started


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
        workers = Workers(
            timed, Output(quiet=True).worker_setup(remote=True), 1, 0, 2
        )  # as many portions on one node as on two
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
    print(
        "| tasks | number | 1 node, s | 2 nodes, s | efficiency | of equal tasks | by node | CPU s | share of a core |"
    )
    print("|" + " --- |" * 9)
    for found in (one, two):
        found.done["all"] = [d for done in found.done.values() for d in done]
        found.seconds["all"] = sum(found.seconds.values())
    ideal = {kind: makespan([d.ended - d.began for d in done], 2) for kind, done in one.done.items()}
    ideal["all"] = sum(seconds for kind, seconds in ideal.items() if kind != "all")
    for kind, done in two.done.items():
        a, b = one.seconds[kind], two.seconds[kind]
        by_node = sorted(Counter((d.node, d.cores) for d in done).items())
        nodes = ", ".join(f"{number} on {cores}" for (_, cores), number in by_node)
        cpu, held = zip(*(shares(f.done[kind]) for f in (one, two)), strict=True)
        print(f"| {kind} | {len(done)} | {a:.1f} | {b:.1f} | {a / b / 2:.2f} | {a / ideal[kind] / 2:.2f} | {nodes} | "
              f"{cpu[0]:.1f}, {cpu[1]:.1f} | {held[0]:.0%}, {held[1]:.0%} |")  # fmt: skip


def shares(done: Sequence[Done]) -> tuple[float, float]:
    """CPU seconds of the calls, and which part of their time they had a core: far less than all of it tells that
    something else ran there, so that the measurement says nothing."""
    cpu = sum(d.cpu for d in done)
    return cpu, cpu / sum(d.ended - d.began for d in done)


if __name__ == "__main__":
    main()
