"""One process leads a run, on a disk without locks too; what a dead one leaves stops nobody."""

import errno
import fcntl
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.run import lock
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import LEADER, SILENT, RunBusyError, is_led, leading, locked


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """On a disk that answers as NFS without its lock daemon does."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    return RunFolder(tmp_path / "run.msgs")


def test_two_cannot_lead_where_there_are_no_locks(run: RunFolder) -> None:
    run.root.mkdir()
    with locked(run):
        with pytest.raises(RunBusyError), locked(run):
            pass
        assert (run.root / LEADER).exists()
    assert [p.name for p in run.root.iterdir()] == [".lock"]
    with locked(run):
        pass


def test_an_error_of_the_leader_gives_the_lead_up(run: RunFolder) -> None:
    run.root.mkdir()
    with pytest.raises(InputError, match="no"), locked(run):
        raise InputError("no")
    with locked(run):
        pass


LEADS = """
import os, sys
from pathlib import Path
from msgs_slam.pipelines.run.lock import leading
with leading(Path(sys.argv[1])) as led:
    os._exit(0 if led else 1)
"""


def leave(path: Path) -> None:
    """As a process that is killed while it leads."""
    subprocess.run([sys.executable, "-c", LEADS, path], check=True)


def test_the_lead_of_a_killed_process_is_free_at_once(tmp_path: Path) -> None:
    leave(tmp_path / LEADER)
    assert (tmp_path / LEADER).exists()
    with leading(tmp_path / LEADER) as led:
        assert led


def test_another_machine_is_dead_when_it_is_silent(tmp_path: Path) -> None:
    path = tmp_path / LEADER
    leave(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"mark": "elsewhere"}))
    with leading(path) as led:
        assert not led
    os.utime(path, (time.time() - SILENT - 5,) * 2)
    with leading(path) as led:
        assert led
    assert list(tmp_path.iterdir()) == []


def test_a_leader_that_was_taken_for_dead_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT", 0.01)
    with leading(tmp_path / LEADER):
        (tmp_path / LEADER).write_text("another's")
        with pytest.raises(KeyboardInterrupt):
            time.sleep(10)
    assert (tmp_path / LEADER).read_text() == "another's"


def test_a_leader_gives_signs_of_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT", 0.01)
    with leading(tmp_path / LEADER):
        os.utime(tmp_path / LEADER, (0, 0))
        while (tmp_path / LEADER).stat().st_mtime == 0:
            time.sleep(0.01)


def test_a_network_disk_that_locks_only_what_may_be_written_knows_its_leader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As NFS answers on Linux (flock(2))."""
    flock = fcntl.flock

    def of_nfs(stream: IO[bytes], operation: int) -> None:
        if fcntl.fcntl(stream, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flock(stream, operation)

    monkeypatch.setattr("fcntl.flock", of_nfs)
    run = RunFolder(tmp_path / "run.msgs")
    assert not is_led(run)
    with locked(run):
        assert is_led(run)
    assert not is_led(run)


def test_a_run_that_may_only_be_read_knows_its_leader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, opened = RunFolder(tmp_path / "run.msgs"), Path.open

    def refused(path: Path, mode: str = "r", **more: object) -> IO[bytes]:
        if mode == "r+b":
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, mode, **more)  # type: ignore[call-overload, no-any-return]

    with locked(run):
        monkeypatch.setattr(Path, "open", refused)
        assert is_led(run)
