"""Signals, rights, full disks, code pages and what a terminal would obey."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_runs import FinishedRun, invoke

from msgs_slam.formats.errors import DiskFullError
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.run import runner
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.runner import forget_peak, peak_memory_mb
from msgs_slam.pipelines.system.progress import Stopped, is_asked, soft_stop, stop_if_asked

COMMAND = [sys.executable, "-m", "msgs_slam"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_first_signal_asks_and_the_second_ends(number: signal.Signals) -> None:
    told: list[int] = []
    with soft_stop(told.append):
        signal.raise_signal(number)
        assert is_asked()
        assert told == [number]
        with pytest.raises(Stopped):
            stop_if_asked()
    assert not is_asked()
    with soft_stop(told.append):
        signal.raise_signal(number)
        with pytest.raises(Stopped):
            signal.raise_signal(number)
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with soft_stop(told.append):
            signal.raise_signal(number)
            assert not is_asked(), "what is ignored (nohup) stays ignored"
    finally:
        signal.signal(number, before)


def test_sigterm_ends_softly_and_the_run_goes_on_to_the_same_bytes(copied_run: Callable[[str], Path]) -> None:
    """A stop by signal, and a run that nobody stops, with the same new setting."""
    change = ("--set", "mapping.min_iterations=60")
    whole, stopped = copied_run("whole.msgs"), copied_run("stopped.msgs")
    process = subprocess.Popen(
        [*COMMAND, "resume", str(stopped), *change, "-q"], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    while process.poll() is None and not (stopped / "mapping.partial").exists():
        time.sleep(0.005)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGTERM, errors
    assert "Stopping at the next snapshot" in errors
    assert f"msgs-slam resume {stopped}" in errors
    assert (stopped / "mapping.partial" / "snapshot" / "submaps_1" / "made_state_0000.safetensors").exists()
    for run in (stopped, whole):
        assert invoke("resume", run, *change, "-q").exit_code == 0
    found, expected = (RunFolder(r).records for r in (stopped, whole))
    assert {n: r.content for n, r in found.items()} == {n: r.content for n, r in expected.items()}


def test_output_to_a_full_disk_and_to_an_old_code_page(finished_run: FinishedRun) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*COMMAND, "config"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr
    old = subprocess.run([*COMMAND, "config"], capture_output=True, env=os.environ | {"PYTHONIOENCODING": "cp1252"})
    assert old.returncode == 0
    assert "λ_D" in old.stdout.decode("utf-8")


def test_what_a_terminal_would_obey_is_written_out(tmp_path: Path) -> None:
    result = invoke("status", tmp_path / "red\x1b[31m\udcff")
    assert result.exit_code == 1
    assert "red\\x1b[31m\\udcff" in result.stderr
    assert "\x1b" not in result.stderr


def test_devices_and_odd_numbers_are_refused(finished_run: FinishedRun, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    refused = invoke("report", finished_run.folder, "--to", pipe)
    assert refused.exit_code == 1
    assert "a device or a pipe" in refused.stderr
    assert pipe.is_fifo()
    assert "--fps is 0.1 to 240" in invoke("render", finished_run.folder, tmp_path / "x.mp4", "--fps", "nan").stderr


def test_video_that_the_disk_has_cut_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    frames = [np.full((48, 64, 3), 40 * i + np.arange(64)[:, None], np.uint8) for i in range(5)]
    whole = write_video(tmp_path / "whole.avi", frames, 10.0).read_bytes()

    class Cut:
        """What OpenCV does on a full disk: it writes less, and says nothing."""

        def __init__(self, path: str, *_: object) -> None:
            self.path = path

        def isOpened(self) -> bool:
            return True

        def write(self, frame: object) -> None:
            pass

        def release(self) -> None:
            Path(self.path).write_bytes(whole[: len(whole) // 2])

        fourcc = staticmethod(lambda *_: 0)

    monkeypatch.setattr("cv2.VideoWriter", Cut)
    with pytest.raises(DiskFullError, match="of 5 frames could be written"):
        write_video(tmp_path / "cut.avi", frames, 10.0)
    assert not (tmp_path / "cut.avi").exists()


def test_memory_is_known_without_proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "_PROCESS", tmp_path / "none")
    forget_peak()
    assert peak_memory_mb() > 10


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_rights_is_a_message(finished_run: FinishedRun, tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    refused = invoke("reconstruct", finished_run.video, "--out", closed / "run.msgs")
    assert refused.exit_code == 1
    assert "cannot be made" in refused.stderr
