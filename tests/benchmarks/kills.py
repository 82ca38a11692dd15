"""SIGKILL at random moments, and right before or after every kind of call that changes the disk: same bytes, always.

    python tests/benchmarks/kills.py --kills 1000 --work DIR [--seed 0]

A process that has everything imported and compiled forks one child after another; the child reconstructs, or resumes,
a tiny clip of the synthetic room, and is killed. Half of the kills come after a random time, a third inside the
child's n-th call of os.replace, os.fsync, os.unlink, os.rmdir, os.mkdir or os.open, before or after it, the others
inside a call for run.toml or manifest.json. When a child ends by itself, the stages are compared, file by file, with
those of a run that nobody has killed; then a setting is changed, which makes a stage and what follows out of date,
and it goes on. Says how many kills there were, in which stages, at which calls and files, how many hit the resume of
a resume that was killed too, and what differed. Figures of several seeds add up; each takes one core.
"""

# ruff: noqa: E402 (the tests' world is found only once the path is set)

import argparse
import collections
import json
import os
import random
import re
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from msgs_slam.formats.reading import file_sha256
from msgs_slam.formats.textfile import read_json_object, write_json
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.reconstruct import reconstruct, resume
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.identity import package_digest
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.world import ClipOptions, iter_clip, make_world

SETTINGS = (
    "run.threads=1", "run.device=cpu", "frames.max_features=600", "proxy.stereo_side=64",
    "mapping.passes=1",
    "mapping.min_iterations=20", "mapping.max_gaussians=3000", "export.voxel=0.1",
)  # fmt: skip
CHANGES = (
    (), ("export.axes=first",), ("proxy.stereo_side=60",), ("mapping.min_iterations=24",), ("export.voxel=0.08",),
    ("global_ba.posed=picked",), ("mapping.refine_poses=false",), ("frames.max_features=500",),
)  # fmt: skip
"""Settings of one round after the other, each beside SETTINGS: rounds begin at different stages."""
CALLS = ("replace", "fsync", "unlink", "rmdir", "mkdir", "open")
RECORDS = re.compile(r"(run|manifest)(\.tmp)?\.(toml|json)$")
FIRST_WAIT = 0.2
"""Seconds of CPU, on average, before a kill after a random time: a twentieth of what the tiny clip takes."""
Kill = tuple[str, int, bool, bool]
"""Inside which call, its how manieth, before or after it, and whether only those for `RECORDS` count."""


def make_clip(path: Path) -> Path:
    """10 frames of 128 x 96, as few as structure from motion is sure of."""
    options = ClipOptions(frames=10, width=128, height=96, fps=10.0, laps=0.2)
    return write_video(path, [f.rgb for f in iter_clip(make_world(texel=0.02), options)], options.fps)


def settings(change: tuple[str, ...]) -> Config:
    """Of one round."""
    return load_config(overrides=[*SETTINGS, *change])


def digests(run: RunFolder) -> dict[str, str]:
    """Of every file of every stage."""
    files = [p for stage in STAGES for p in sorted(run.stage(stage).rglob("*")) if p.is_file()]
    return {str(p.relative_to(run.root)): file_sha256(p) for p in files}


def in_child(work: Callable[[], Any], kill: Kill | None = None, tell: int | None = None) -> int:
    """Fork; the child does the work and exits 0, or 1 with its traceback on stderr. Returns its process id."""
    child = os.fork()
    if child:
        return child
    try:
        if kill is not None:
            arm(*kill, tell)
        work()
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    finally:  # whatever happens: the parent's frames are not this process's to leave
        os._exit(1)
    return 0


def arm(name: str, count: int, before: bool, records: bool, tell: int | None) -> None:
    """Make this process kill itself at its `count`-th call of os.`name`, and write its file's name to `tell` first."""
    real, left = getattr(os, name), [count]

    def call(*args: Any, **kwargs: Any) -> Any:
        path = args[-1] if name == "replace" else args[0]
        path = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.fspath(path)
        if records and not RECORDS.search(path):
            return real(*args, **kwargs)
        left[0] -= 1
        if left[0] == 0 and tell is not None:
            os.write(tell, f"{name} {path}".encode())
        if left[0] == 0 and before:
            os.kill(os.getpid(), signal.SIGKILL)
        result = real(*args, **kwargs)
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(os, name, call)


def stage_at(run: RunFolder) -> str:
    """The unfinished stage, "between" where there is none."""
    return next((s for s in STAGES if run.partial(s).exists()), "between")


def unbroken(clip: Path, work: Path) -> list[dict[str, str]]:
    """Digests after every round, of a run that nobody kills; kept in `work` for the next call with the same code."""
    kept, code = work / "whole.json", [package_digest(), SETTINGS, CHANGES]
    code = json.loads(json.dumps(code))
    if kept.exists() and (found := read_json_object(kept))["code"] == code:
        return found["digests"]
    run, digests_after = RunFolder(work / "whole.msgs"), []
    shutil.rmtree(run.root, ignore_errors=True)
    for change in CHANGES:
        child = in_child(lambda c=change: reconstruct(clip, run, settings(c), SilentProgress()))  # type: ignore[misc]
        assert os.waitpid(child, 0)[1] == 0, "the unbroken run failed"
        digests_after.append(digests(run))
    write_json(kept, {"code": code, "digests": digests_after})
    return digests_after


@dataclass
class Killer:
    """Starts children on one run and kills them; counts the kills."""

    clip: Path
    run: RunFolder
    rng: random.Random
    counts: collections.Counter[str] = field(default_factory=collections.Counter)

    def attempt(self, work: Callable[[], Any], kill: Kill | None, patience: float) -> bool:
        """Whether the child was killed; else it has ended well, or the benchmark ends."""
        incoming, outgoing = os.pipe()
        child = in_child(work, kill, outgoing)
        os.close(outgoing)
        seconds, deadline = self.rng.expovariate(1 / patience), time.monotonic() + 600
        while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0) and time.monotonic() < deadline:
            if cpu_seconds(child) > seconds:
                break
            time.sleep(0.002)
        if ended == (0, 0):
            os.kill(child, signal.SIGKILL)
            ended = os.waitpid(child, 0)
        with os.fdopen(incoming) as stream:
            place = where(stream.read())
        if os.WIFSIGNALED(ended[1]):
            self.counts["kills"] += 1
            self.counts[f"in {stage_at(self.run)}"] += 1
            self.counts[f"at {place}"] += 1
            return True
        if os.WEXITSTATUS(ended[1]) != 0:
            raise SystemExit(f"a child failed; the run is kept in {self.run.root}")
        return False

    def start(self, config: Config) -> Any:
        """As `msgs-slam reconstruct`."""
        return reconstruct(self.clip, RunFolder(self.run.root), config, SilentProgress())

    def go_on(self, config: Config) -> Any:
        """As `msgs-slam resume`: from the settings in run.toml, where they are those of this round."""
        run = RunFolder(self.run.root)
        own = run.settings_file.exists() and run.settings() == config
        return resume(run, SilentProgress(), None if own else config)

    def first_moments(self, config: Config) -> None:
        """A new run is killed while its first records are written; the same command goes on."""
        for number in range(1, 7):
            for call in ("replace", "fsync", "unlink"):
                shutil.rmtree(self.run.root, ignore_errors=True)
                self.attempt(lambda: self.start(config), (call, number, self.rng.random() < 0.5, True), 60)
                self.attempt(lambda: self.start(config), None, FIRST_WAIT)

    def one_round(self, config: Config) -> None:
        """Kill until a child ends by itself. Waits grow while nothing gets done, so that every piece of work fits."""
        stuck, resumed, killed = 0, 0, True
        while killed:
            kill = chosen_kill(self.rng, stuck)
            resumes = self.run.manifest_file.exists() and self.rng.random() < 0.7
            before = size_of(self.run)
            # Some calls come too seldom to be waited for.
            patience = FIRST_WAIT * (1 + stuck) * (1 if kill is None else 3)
            killed = self.attempt(lambda r=resumes: self.go_on(config) if r else self.start(config), kill, patience)  # type: ignore[misc]
            resumed = resumed + 1 if resumes else 0
            self.counts["of a resume of a killed resume"] += killed and resumed > 1
            stuck = 0 if size_of(self.run) > before else stuck + 1


def chosen_kill(rng: random.Random, stuck: int) -> Kill | None:
    """None for a random time."""
    if rng.random() < 0.5:
        return None
    if rng.random() < 0.3:
        return rng.choice(("replace", "fsync", "unlink")), rng.randint(1, 4), rng.random() < 0.5, True
    return rng.choice(CALLS), rng.randint(1, 12 + 4 * stuck), rng.random() < 0.5, False


def cpu_seconds(process: int) -> float:
    """What it has used; a busy machine must not make random times come sooner."""
    return int(Path(f"/proc/{process}/schedstat").read_text().split()[0]) / 1e9


def size_of(run: RunFolder) -> int:
    """How many files there are."""
    return sum(p.is_file() for p in run.root.rglob("*")) if run.root.exists() else 0


def where(told: str) -> str:
    """The call that a child was killed in, and the record that it was for, if any."""
    call, _, path = told.partition(" ")
    found = RECORDS.search(path)
    return f"{call}, {found[1]}" if found else call or "a random time"


def main() -> None:
    """See the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    clip = options.work / "clip.avi"
    # In a child too: a process whose libraries have begun threads of their own cannot be forked any more.
    os.waitpid(in_child(lambda: make_clip(clip)), 0)

    whole = unbroken(clip, options.work)
    run = RunFolder(options.work / "killed.msgs")
    killer = Killer(clip, run, random.Random(options.seed))
    counts, differing, rounds = killer.counts, 0, 0
    while counts["kills"] < options.kills:
        config, expected = settings(CHANGES[rounds % len(CHANGES)]), whole[rounds % len(CHANGES)]
        if rounds % len(CHANGES) == 0:
            killer.first_moments(config)
        killer.one_round(config)
        rounds += 1
        found = digests(run)
        if found != expected:
            differing += 1
            wrong = [n for n in {*found, *expected} if found.get(n) != expected.get(n)]
            print(f"round {rounds}: {len(wrong)} files differ: {sorted(wrong)[:5]}", flush=True)
            shutil.copytree(run.root, options.work / f"differs{rounds}.msgs", dirs_exist_ok=True)
        print(json.dumps({"kills": counts["kills"], "rounds": rounds, "differing": differing}), flush=True)
    print(json.dumps({"rounds": rounds, "differing": differing, **dict(sorted(counts.items()))}, indent=1))
    sys.exit(differing > 0)


if __name__ == "__main__":
    main()
