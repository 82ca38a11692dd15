"""`msgs-slam work`: the run of many processes is that of one."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from cli_runs import invoke

from msgs_slam.formats.reading import file_sha256
from msgs_slam.pipelines.run.folder import RunFolder, load_records

DIVIDED = ("--set", "mapping.submap=5", "--until", "mapping", "-q")


def contents(run: Path) -> dict[str, str]:
    files = (p for p in sorted((run / "mapping").rglob("*")) if p.is_file())
    return {str(p.relative_to(run)): file_sha256(p) for p in files}


def test_two_shards_at_a_time_leave_what_one_process_does(copied_run: Callable[[str], Path]) -> None:
    """One process alone, of a share that has no task, and then two at the same time."""
    whole, alone, both = copied_run("whole.msgs"), copied_run("alone.msgs"), copied_run("both.msgs")
    assert invoke("resume", whole, *DIVIDED).exit_code == 0
    for run in (alone, both):
        assert invoke("resume", run, "--set", "mapping.submap=5", "--until", "tracking", "-q").exit_code == 0
    found = invoke("work", alone, "--shard", "15/16", "--until", "mapping", "-q")
    assert found.exit_code == 0, found.stderr
    command = [sys.executable, "-m", "msgs_slam", "work", str(both), "--until", "mapping", "-q", "--shard"]
    processes = [subprocess.Popen([*command, f"{k}/2"]) for k in range(2)]
    assert [p.wait(timeout=300) for p in processes] == [0, 0]
    assert load_records(RunFolder(whole))["mapping"].figures["submaps"] == 3
    assert contents(whole) == contents(alone) == contents(both)
    assert not (alone / ".tasks").exists()


def test_what_cannot_be_is_refused(finished_run: object, tmp_path: Path) -> None:
    assert "K from 0 to N - 1" in invoke("work", finished_run.folder, "--shard", "3/3").stderr  # type: ignore[attr-defined]
    missing = invoke("work", tmp_path, "--shard", "0/3")
    assert missing.exit_code == 1
    assert "is not a run folder" in missing.stderr
