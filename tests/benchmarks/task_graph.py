"""How long a recording takes on 1 to 256 workers: a simulation of the task graph with the measured times of a run.

    python tests/benchmarks/task_graph.py RUN.msgs [--keyframes 16900] [--each 1.08]

Nothing is run: the seconds a keyframe of RUN's stages (made on one thread) are spread over the tasks into which
`reconstruct --engine ray` and `work` divide them, and those are given to workers as they become free, longest first.
What is divided: the shares of the stages in DIVIDED, in three portions a worker; windows of structure from motion;
regions of the mesh; and the submaps of the map, each made of its own and the bordering keyframes, joined, refined (5
visits beside 9) and measured. Everything else stays in one process. Each kind of task is done before the next begins;
--start seconds go by before a worker's first task (the imports), --each is by how much tasks take longer than in one
process.
"""

import argparse
import heapq
import json
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

BORDER, SUBMAP, PORTIONS = 16, 250, 3
JOIN, REFINE, MEASURE = 0.05, 0.62, 0.05
"""Of the time of making a submap: joined and measured 4 of 34 seconds (a walk in parts of 18), refined 105 of 170 (a
kitchen in thirds)."""
DIVIDED = {
    "frames": {"features": 0.30, "pairs": 0.19},
    "proxy": {"depths": 0.76, "networks": 0.09, "moving": 0.03, "maps": 0.09},
    "export": {"drawing": 0.34},
}
"""Shares of a stage's time that are done in portions (whiteroom, 81 keyframes, one thread, cProfile)."""
WINDOWS, WINDOW, AGAIN = 0.30, 460, 0.12
"""Share of `frames` that makes the models of windows of so many new keyframes; how much of it is done again by the one
process that joins them, which finds the mapper's models but adjusts them itself."""
REGIONS, REGION = 0.13, 20
"""Share of `export` that fuses and paints regions, and keyframes a region: 400 blocks a keyframe, 8,000 at a time."""
ONCE = 0.37
"""Share of `export` that does not grow: up and metres are told by 24 views however many there are."""


def makespan(tasks: Sequence[float], workers: int) -> float:
    """Seconds until all are done, the longest first, each by the worker that is free first."""
    free = [0.0] * min(workers, max(len(tasks), 1))
    for task in sorted(tasks, reverse=True):
        heapq.heapreplace(free, free[0] + task)
    return max(free)


def phases(per_keyframe: dict[str, float], found: int, keyframes: int, workers: int) -> dict[str, list[float]]:
    """Seconds of the tasks of each kind, for so many keyframes, by a run with `found`."""
    whole = {stage: seconds * keyframes for stage, seconds in per_keyframe.items()}
    portions, parts = min(PORTIONS * workers, keyframes), max(1, round(keyframes / SUBMAP))
    out = {
        f"{stage}, {kind}": [whole[stage] * share / portions] * portions
        for stage, kinds in DIVIDED.items()
        for kind, share in kinds.items()
    }
    alone = {stage: 1 - sum(DIVIDED.get(stage, {}).values()) for stage in whole if stage != "mapping"}
    windows, regions = round(keyframes / WINDOW), max(1, round(keyframes / REGION))
    if windows > 1:
        out["frames, windows"] = [whole["frames"] * WINDOWS / windows] * windows
        alone["frames"] -= WINDOWS - AGAIN
    out["export, regions"] = [whole["export"] * REGIONS / regions] * regions
    alone["export"] -= REGIONS + ONCE * (1 - found / keyframes)
    made = whole["mapping"] / parts * (1 + (BORDER * parts / keyframes if parts > 1 else 0))
    out["mapping"] = [made] * parts
    if parts > 1:
        out |= {f"mapping, {name}": [made * share] * parts
                for name, share in (("joined", JOIN), ("refined", REFINE), ("measured", MEASURE))}  # fmt: skip
    return out | {f"{stage}, alone": [whole[stage] * share] for stage, share in alone.items()}


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--keyframes", type=int, default=0, help="of the recording; 0: those of RUN")
    parser.add_argument("--start", type=float, default=5.0)
    parser.add_argument("--each", type=float, default=1.0)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4, 8, 16, 32, 64, 128, 256])
    given = parser.parse_args()
    stages = json.loads((given.run / "manifest.json").read_text())["stages"]
    found = stages["tracking"]["figures"]["keyframes"]
    per_keyframe = {name: stage["seconds"] / found for name, stage in stages.items()}
    print("| workers | hours | speed-up | efficiency | longest |\n|" + " --- |" * 5)
    alone = sum(sum(t) for t in phases(per_keyframe, found, given.keyframes or found, 1).values())
    for workers in given.workers:
        of = phases(per_keyframe, found, given.keyframes or found, workers)
        dear = given.each if workers > 1 else 1.0
        spans = {name: makespan([t * (dear if len(t_) > 1 else 1) for t in t_], workers) for name, t_ in of.items()}
        total = sum(spans.values()) + (given.start if workers > 1 else 0)
        longest = sorted(spans, key=lambda name: -spans[name])[:3]
        told = ", ".join(f"{name} {100 * spans[name] / total:.0f} %" for name in longest)
        print(f"| {workers} | {total / 3600:.2f} | {alone / total:.2f} | {alone / total / workers:.2f} | {told} |")


if __name__ == "__main__":
    main()
