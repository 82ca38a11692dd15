"""One process works on a run, on a disk without locks too; what a dead one leaves stops no other."""

import errno
import fcntl
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import LOCK, SOFT_LOCK, RunBusyError, is_locked, locked


def no_locks(*_: object) -> None:
    """As NFS without its lock daemon."""
    raise OSError(errno.ENOLCK, "No locks available")


@pytest.fixture(params=["locks", "no locks"])
def run(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    if request.param == "no locks":
        monkeypatch.setattr("fcntl.flock", no_locks)
    return RunFolder(tmp_path / "run.msgs")


def test_a_second_process_is_refused_and_told_of_the_first(run: RunFolder) -> None:
    run.root.mkdir()
    for _ in range(2):
        assert not is_locked(run)
        with locked(run):
            assert is_locked(run)
            with pytest.raises(RunBusyError) as refused, locked(run):
                pass
            assert str(os.getpid()) in str(refused.value)
            assert platform.node() in str(refused.value)
    with pytest.raises(InputError, match="of the work"), locked(run):
        raise InputError("of the work")
    assert not is_locked(run)
    assert {p.name for p in run.root.iterdir()} <= {LOCK}


HOLDS = """
import errno, os, sys
from pathlib import Path
if sys.argv[2] == "no locks":
    def flock(*_): raise OSError(errno.ENOLCK, "No locks available")
    import fcntl
    fcntl.flock = flock
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
with locked(RunFolder(Path(sys.argv[1]))):
    os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize("kind", ["locks", "no locks"])
def test_the_lock_of_a_killed_process_is_free_at_once(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    run.root.mkdir()
    subprocess.run([sys.executable, "-c", HOLDS, str(run.root), kind], check=False)
    assert (run.root / (LOCK if kind == "locks" else SOFT_LOCK)).exists()
    if kind == "no locks":
        monkeypatch.setattr("fcntl.flock", no_locks)
    with locked(run):
        pass


def test_without_locks_a_process_of_another_machine_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", no_locks)
    run = RunFolder(tmp_path)
    (tmp_path / SOFT_LOCK).write_text("4711\nelsewhere\n")
    named = rf"4711 elsewhere.*if it has been killed .* delete .*{SOFT_LOCK}"
    with pytest.raises(RunBusyError, match=named), locked(run):
        pass


def of_nfs(flock: Callable[..., None]) -> Callable[..., None]:
    """As NFS answers on Linux (flock(2)): it locks only what may be written."""

    def answer(stream: IO[bytes] | int, operation: int) -> None:
        if fcntl.fcntl(stream, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        flock(stream, operation)

    return answer


def test_a_network_disk_that_locks_only_what_may_be_written_knows_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", of_nfs(fcntl.flock))
    run = RunFolder(tmp_path / "run.msgs")
    assert not is_locked(run)
    with locked(run):
        assert is_locked(run)
    assert not is_locked(run)


def test_a_run_that_may_only_be_read_knows_its_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, opened = RunFolder(tmp_path / "run.msgs"), Path.open

    def refused(path: Path, mode: str = "r", **more: object) -> IO[bytes]:
        if mode == "r+b":
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, mode, **more)  # type: ignore[call-overload, no-any-return]

    with locked(run):
        monkeypatch.setattr(Path, "open", refused)
        assert is_locked(run)
