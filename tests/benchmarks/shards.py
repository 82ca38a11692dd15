"""Many processes at one run (`msgs-slam work`): in any order, twice at a time, killed; the run is that of one process.

    python tests/benchmarks/shards.py --work DIR --shards 16 --seed 0
    python tests/benchmarks/shards.py --work DIR --source VIDEO --shards 2 --kills 0 --set mapping.submap=15

A clip of the demo's room, or another recording, is reconstructed by one process, then by processes of which each takes
one shard: begun in random order, at most --beside at the same time, each second one of them twice, some killed
(SIGKILL) after a random time and begun again later. What all stages have left is compared by its bytes.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.demo import unpack_demo_clip

SETTINGS = (
    "run.threads=1", "frames.rate=4", "frames.max_features=600", "proxy.stereo_side=96", "proxy.stereo_planes=24",
    "mapping.passes=1", "mapping.min_iterations=20", "mapping.max_side=160", "mapping.submap=6", "export.voxel=0.03",
)  # fmt: skip


def msgs_slam(*arguments: object) -> list[str]:
    """The command, for subprocess."""
    return [sys.executable, "-m", "msgs_slam", *map(str, arguments), "-q"]


def beginning(video: Path, run: Path, until: str, *more: str) -> list[str]:
    """The command, with further settings."""
    chosen = [part for setting in (*SETTINGS, *more) for part in ("--set", setting)]
    return msgs_slam("reconstruct", video, "--out", run, "--until", until, *chosen)


def begin(video: Path, run: Path, until: str, *more: str) -> None:
    """By one process."""
    subprocess.run(beginning(video, run, until, *more), check=True, cwd=ROOT)


def by_shards(run: Path, count: int, beside: int, kills: int, rng: random.Random) -> dict[str, int]:
    """Processes until every shard has ended well once; how many there were, and how many were killed."""
    waiting = [k for k in range(count) for _ in range(1 + k % 2)]
    rng.shuffle(waiting)
    running: dict[subprocess.Popen[bytes], tuple[int, float]] = {}
    told = {"begun": 0, "killed": 0, "failed": 0}
    while waiting or running:
        while waiting and len(running) < beside:
            shard, doomed = waiting.pop(), kills > told["killed"] and rng.random() < 0.7
            process = subprocess.Popen(msgs_slam("work", run, "--shard", f"{shard}/{count}"), cwd=ROOT)
            running[process] = shard, time.monotonic() + (rng.uniform(3, 25) if doomed else 1e9)
            told["begun"] += 1
        time.sleep(0.1)
        for process, (shard, until) in list(running.items()):
            if process.poll() is None and time.monotonic() > until:
                process.kill()
                process.wait()
                told["killed"] += 1
            if process.poll() is not None:
                del running[process]
                told["failed"] += process.returncode not in (0, -9)
                if process.returncode:
                    waiting.insert(0, shard)
    return told


def contents(run: Path) -> dict[str, str]:
    """Digest of every file that the stages have left."""
    files = (p for stage in STAGES for p in (run / stage).rglob("*") if p.is_file())
    return {str(p.relative_to(run)): file_sha256(p) for p in files}


def main() -> None:
    """Print what was done and which files differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--shards", type=int, default=16)
    parser.add_argument("--beside", type=int, default=4, help="processes at the same time")
    parser.add_argument("--kills", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--source", type=Path, help="a recording in place of the demo's clip")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()
    video = arguments.source or unpack_demo_clip(arguments.work)[0]
    whole, shared = arguments.work / "whole.msgs", arguments.work / "shared.msgs"
    begin(video, whole, STAGES[-1], *arguments.settings)
    shutil.rmtree(shared, ignore_errors=True)
    begin(video, shared, "frames", *arguments.settings)
    started = time.monotonic()
    told = by_shards(shared, arguments.shards, arguments.beside, arguments.kills, random.Random(arguments.seed))
    seconds, (one, many) = time.monotonic() - started, (contents(r) for r in (whole, shared))
    differing = sorted(name for name in one.keys() | many.keys() if one.get(name) != many.get(name))
    left = [p.name for p in shared.iterdir() if p.name not in (*STAGES, ".lock", "run.toml", "manifest.json")]
    print(json.dumps({**told, "seconds": round(seconds), "files": len(one), "differing": differing, "left": left}))
    sys.exit(bool(differing or left))


if __name__ == "__main__":
    main()
