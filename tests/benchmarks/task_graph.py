"""How long a recording takes on 1 to 256 workers: a simulation of the task graph with the measured times of a run.

    python tests/benchmarks/task_graph.py RUN.msgs [--keyframes 16900] [--proxy-share 0.8] [--each 1.15]

Nothing is run: the seconds a keyframe of RUN's stages (made on one thread) are spread over the tasks into which
`reconstruct --engine ray` and `work` divide them, and those are given to workers as they become free, longest first.
What is divided: the depth of the keyframes (the share --proxy-share of `proxy`) in three portions a worker, and the
submaps of the map, each made of its own and the bordering keyframes, joined, refined (two visits of nine) and measured,
one kind after the other. Everything else stays in one process. Every kind of task is done before the next begins;
--start seconds go by before a worker's first task (the imports), --each is by how much tasks take longer than in one
process.
"""

from __future__ import annotations

import argparse
import heapq
import json
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

BORDER, SUBMAP, PORTIONS = 16, 250, 3
JOIN, REFINE, MEASURE = 0.05, 0.25, 0.05
"""Of the time of making a submap: joined and measured 4 + 4 of 34 seconds, refined 11 (a walk in parts of 18)."""


def makespan(tasks: Sequence[float], workers: int) -> float:
    """Seconds until all are done, the longest first, each by the worker that is free first."""
    free = [0.0] * min(workers, max(len(tasks), 1))
    for task in sorted(tasks, reverse=True):
        heapq.heapreplace(free, free[0] + task)
    return max(free)


def phases(per_keyframe: dict[str, float], keyframes: int, workers: int, proxy_share: float) -> dict[str, list[float]]:
    """Tasks of each kind, in the order in which the kinds are done."""
    whole = {stage: seconds * keyframes for stage, seconds in per_keyframe.items()}
    parts = max(1, round(keyframes / SUBMAP))
    portions = min(PORTIONS * workers, keyframes)
    made = whole["mapping"] / parts * (1 + (BORDER * parts / keyframes if parts > 1 else 0))
    mapping = {"mapping": [made] * parts}
    if parts > 1:
        mapping |= {f"mapping, {name}": [made * share] * parts
                    for name, share in (("joined", JOIN), ("refined", REFINE), ("measured", MEASURE))}  # fmt: skip
    return {
        "frames": [whole["frames"]],
        "proxy, depth": [whole["proxy"] * proxy_share / portions] * portions,
        "proxy, classes": [whole["proxy"] * (1 - proxy_share)],
        "tracking": [whole["tracking"]],
        **mapping,
        "global_ba": [whole["global_ba"]],
        "export": [whole["export"]],
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--keyframes", type=int, default=0, help="of the recording; 0: those of RUN")
    parser.add_argument("--proxy-share", type=float, default=0.76)
    parser.add_argument("--start", type=float, default=5.0)
    parser.add_argument("--each", type=float, default=1.0)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4, 8, 16, 32, 64, 128, 256])
    given = parser.parse_args()
    stages = json.loads((given.run / "manifest.json").read_text())["stages"]
    found = stages["tracking"]["figures"]["keyframes"]
    per_keyframe = {name: stage["seconds"] / found for name, stage in stages.items()}
    print("| workers | hours | speed-up | efficiency | longest |\n|" + " --- |" * 5)
    alone = sum(sum(t) for t in phases(per_keyframe, given.keyframes or found, 1, given.proxy_share).values())
    for workers in given.workers:
        of = phases(per_keyframe, given.keyframes or found, workers, given.proxy_share)
        dear = given.each if workers > 1 else 1.0
        spans = {name: makespan([t * (dear if len(t_) > 1 else 1) for t in t_], workers) for name, t_ in of.items()}
        total = sum(spans.values()) + (given.start if workers > 1 else 0)
        longest = sorted(spans, key=lambda name: -spans[name])[:3]
        told = ", ".join(f"{name} {100 * spans[name] / total:.0f} %" for name in longest)
        print(f"| {workers} | {total / 3600:.2f} | {alone / total:.2f} | {alone / total / workers:.2f} | {told} |")


if __name__ == "__main__":
    main()
