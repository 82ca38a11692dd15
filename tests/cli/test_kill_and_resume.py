"""SIGKILL in every stage: the run goes on, keeps what is finished, and ends with the bytes of an unbroken run.

Nothing is written beside the run folder meanwhile, not even by what is killed.
"""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from cli_runs import QUICK, FinishedRun, elsewhere, files_below

from msgs_slam.pipelines.config import STAGES

COMPARED = ("frames", "proxy", "tracking", "mapping", "global_ba", "export")


def start(environment: dict[str, str], *arguments: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "msgs_slam", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment)


def finish(process: subprocess.Popen[bytes]) -> None:
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors.decode()[-3000:]


def kill_when(process: subprocess.Popen[bytes], reached: Callable[[], bool]) -> bool:
    """SIGKILL as soon as `reached`; False when the process ended by itself before."""
    while process.poll() is None:
        if reached():
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            return True
        time.sleep(0.01)
    process.communicate()
    return False


def digests(run: Path) -> dict[str, str]:
    """Of every file of every stage."""
    files = [p for stage in COMPARED for p in sorted((run / stage).rglob("*")) if p.is_file()]
    return {str(p.relative_to(run)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def written(folder: Path, more_than: int) -> Callable[[], bool]:
    """Whether the stage has begun to write its own files (the stamp and its folder aside)."""
    return lambda: folder.exists() and sum(p.is_file() for p in folder.rglob("*")) > more_than


def finished_at(run: Path) -> dict[str, float]:
    stages = json.loads((run / "manifest.json").read_text())["stages"]
    return {name: (run / name).stat().st_mtime for name in stages}


def test_killed_in_every_stage_the_run_ends_as_an_unbroken_one(finished_run: FinishedRun, tmp_path: Path) -> None:
    options = [x for s in QUICK for x in ("--set", s)]
    broken, places = tmp_path / "broken.msgs", elsewhere(tmp_path)
    killed = []
    process = start(places, "reconstruct", finished_run.video, "--out", broken, *options)
    for stage in STAGES:
        if kill_when(process, written(broken / f"{stage}.partial", 1)):
            killed.append(stage)
            before = finished_at(broken)
            assert list(before) == list(STAGES[: STAGES.index(stage)])
        process = start(places, "resume", broken)
    finish(process)
    after = finished_at(broken)
    assert {name: after[name] for name in before} == before, "a finished stage was done again"
    assert set(killed) >= set(STAGES[:4]), f"killed only in {killed}: the others were too quick to catch"
    assert digests(broken) == digests(finished_run.folder)

    # A changed setting of mapping: mapping and what follows are done again, nothing before.
    finish(start(places, "resume", broken, "--set", "mapping.min_iterations=21"))
    later = finished_at(broken)
    assert [name for name in STAGES if later[name] != after[name]] == ["mapping", "global_ba", "export"]
    assert files_below(*(tmp_path / name for name in ("home", "temporary", "here"))) == {}
    assert {p.name for p in tmp_path.iterdir()} == {"broken.msgs", "home", "temporary", "here"}
