"""`--log-format json`: every event is one JSON object a line on stderr, whatever becomes of the command."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cli_runs import QUICK, FinishedRun

from msgs_slam.msgs_cli.output import json_outcome
from msgs_slam.pipelines.system.progress import IN_WORDS

COMMAND = [sys.executable, "-m", "msgs_slam"]
JSON = ("--log-format", "json")


def lines_of(stderr: str) -> list[dict[str, Any]]:
    """The events; libraries may print text between them."""
    found = [json.loads(line) for line in stderr.splitlines() if line.startswith("{")]
    assert all(line["event"] and line["time"] > 1.7e9 for line in found)
    return found


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=300)


def test_a_run_that_is_fine(copied_run: Callable[[str], Path]) -> None:
    folder = copied_run("run.msgs")
    done = run("resume", folder, *JSON, "--set", "mapping.min_iterations=25")
    assert done.returncode == 0, done.stderr[-3000:]
    lines = lines_of(done.stderr)
    stages = [(x["name"], x["index"], x["of"], x["state"]) for x in lines if x["event"] == "stage"]
    assert stages[:3] == [(n, i, 6, "up to date") for i, n in enumerate(("frames", "proxy", "tracking"), 1)]
    later = [(n, i, 6, s) for i, n in enumerate(("mapping", "global_ba", "export"), 4) for s in ("begun", "done")]
    assert stages[3:] == later
    ended = [x for x in lines if x["event"] == "stage" and x["state"] == "done"]
    assert ended[0]["figures"]["gaussians"] > 100
    assert all(x["seconds"] > 0 for x in ended)
    assert [x["seconds_left"] is not None for x in ended] == [True] * 3
    assert ended[-1]["seconds_left"] == 0
    progress = [x for x in lines if x["event"] == "progress"]
    assert {(x["stage"], x["index"], x["of"]) for x in progress} <= {(n, i, 6) for n, i, *_ in later}
    assert {x["label"] for x in progress if x.get("ended")} >= {"mapping", "drawing"}
    assert lines[-1]["event"] == "result"
    assert Path(lines[-1]["export"], "README.txt").exists()
    warned = [x["message"] for x in lines if x["event"] == "warning"]
    assert len(warned) == len(set(warned))


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["reconstruct", "none.mp4"], 1, "no such file"),
        (["reconstruct", "none.mp4", "--nonsense"], 2, "--nonsense"),
        (["reconstruct"], 2, "SOURCE"),
        (["resume", "none.msgs", "--set", "frames.rat=3"], 1, "does not exist"),
        (["reconstruct", "none.mp4", "--set", "frames.rat=3"], 2, "did you mean frames.rate?"),
        (["status", "none.msgs"], 2, "--log-format"),
    ],
)
def test_what_is_refused(words: list[str], code: int, said: str) -> None:
    done = run(*words, *JSON)
    assert done.returncode == code
    *_, last = lines_of(done.stderr)
    assert (last["event"], last["exit_code"]) == ("error", code)
    assert said in last["message"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_a_signal_ends(number: signal.Signals, copied_run: Callable[[str], Path]) -> None:
    folder = copied_run("run.msgs")
    words = [*COMMAND, "resume", str(folder), *JSON, "--set", "mapping.min_iterations=60"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (folder / "mapping.partial").exists():
        time.sleep(0.005)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 128 + number, errors
    lines = lines_of(errors)
    assert [x["signal"] for x in lines if x["event"] == "stopping"] == [number]
    assert [x["name"] for x in lines if x["event"] == "stage" and x["state"] == "stopped"] == ["mapping"]
    assert (lines[-1]["event"], lines[-1]["signal"], lines[-1]["exit_code"]) == ("stopped", number, 128 + number)
    assert f"msgs-slam resume {folder}" in lines[-1]["message"]


def test_a_fault_keeps_its_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, json_outcome():
        print(1 / 0)
    fault = lines_of(capsys.readouterr().err)[-1]
    assert (ended.value.code, fault["event"], fault["exit_code"]) == (1, "error", 1)
    assert "ZeroDivisionError" in fault["message"]
    assert "1 / 0" in fault["traceback"]


def test_the_other_commands_end_with_their_result(finished_run: FinishedRun, tmp_path: Path) -> None:
    done = run("export", finished_run.folder, "--only", "nerfstudio", "--to", tmp_path / "given", *JSON)
    last = lines_of(done.stderr)[-1]
    assert (done.returncode, last["event"]) == (0, "result")
    assert str(tmp_path / "given" / "transforms.json") in last["files"]


def test_a_batch_whose_recordings_have_processes_of_their_own(finished_run: FinishedRun, tmp_path: Path) -> None:
    videos = tmp_path / "videos"
    videos.mkdir()
    (videos / "room.avi").symlink_to(finished_run.video)
    (videos / "broken.mp4").write_bytes(b"no video" * 100)
    settings = [word for text in QUICK for word in ("--set", text)]
    done = run("batch", videos, "-o", tmp_path / "runs", "--until", "frames", *settings, *JSON)
    assert done.returncode == 1
    lines = lines_of(done.stderr)
    states = [(x["job"], x["name"], x["of"], x["state"]) for x in lines if x["event"] == "stage"]
    assert states == [("room", "frames", 1, "begun"), ("room", "frames", 1, "done")]
    result = next(x for x in lines if x["event"] == "result")
    assert result["failed"] == [str(tmp_path / "runs" / "broken.msgs")]
    assert result["exit_code"] == 1
    assert Path(result["table"]).exists()


def test_without_it_a_file_gets_a_line_a_stage(copied_run: Callable[[str], Path]) -> None:
    """No bar is drawn and drawn again where nobody looks."""
    folder = copied_run("run.msgs")
    done = run("resume", folder, "--set", "export.voxel=0.06")
    assert done.returncode == 0
    lines = [line for line in done.stderr.splitlines() if line.startswith("[")]
    assert [line.split("]")[0] for line in lines] == [f"[{i}/6 {name}" for i, name in enumerate(IN_WORDS.values(), 1)]
    assert lines[-1].startswith("[6/6 files] done in ")
    assert "\r" not in done.stderr
    assert "%|" not in done.stderr
