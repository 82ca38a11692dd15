"""A setting is changed and the work is stopped: what every command says then is what the run really holds."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runs import OPTIONS, FinishedRun, invoke

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.reconstruct import made_with, reconstruct
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.manifest import keyframe_psnr
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.wording import figure_text


def interrupt_when(reached: Callable[[], bool], *arguments: object) -> subprocess.CompletedProcess[str]:
    """Start the command in a process of its own and press Ctrl-C as soon as `reached`."""
    command = [sys.executable, "-m", "msgs_slam", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not reached():
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


def states(run: Path) -> dict[str, str]:
    """What `status` says of each stage."""
    rows = [line.split() for line in invoke("status", run).stdout.splitlines() if line]
    return {row[0]: row[1] for row in rows if row[0] in ("frames", "tracking", *LATER)}


LATER = ("mapping", "global_ba", "export")


def test_every_place_gives_one_psnr(finished_run: FinishedRun, copied_run: Callable[[str], Path]) -> None:
    """Status, report, evaluation and the list of a batch, whatever each of them renders besides."""
    run = copied_run("run.msgs")
    records = RunFolder(run).records
    value = keyframe_psnr(records)
    assert value is not None
    assert value > 15
    assert f"keyframe_psnr {figure_text(value)}" in invoke("status", run).stdout
    assert invoke("report", run, "-q").exit_code == 0
    assert f"<b>{value:.1f}</b><span>keyframe PSNR, dB at 160 pixels</span>" in (run / "report.html").read_text()
    table = invoke("evaluate", run, "--truth", finished_run.truth, "-q").stdout
    assert table.splitlines()[2].startswith("| what"), "the table first"
    assert "Umeyama" not in table
    assert "Umeyama" in (run / "evaluation" / "evaluation.md").read_text()
    evaluation = json.loads((run / "evaluation" / "evaluation.json").read_text())
    assert evaluation["keyframe psnr"] == value
    assert f"| PSNR at keyframes | {value:.2f} dB |" in (run / "evaluation" / "evaluation.md").read_text()
    assert evaluation["images"]["keyframes"]["psnr"] == pytest.approx(value, abs=0.05), "at the same size"
    refined = replace(records["global_ba"], figures={**records["global_ba"].figures, "keyframe_psnr": 40.0})
    assert keyframe_psnr({**records, "global_ba": refined}) == 40, "of the map that the run ended with"
    assert keyframe_psnr({"frames": records["frames"]}) is None


def test_a_class_map_of_another_vocabulary_is_warned_of(
    finished_run: FinishedRun, copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    run, mine = copied_run("run.msgs"), tmp_path / "mine.toml"
    mine.write_text('[classes]\nwall = ["wall", "stucco"]\nxyzzy = "wall"\n')
    result = invoke("evaluate", run, "--truth", finished_run.truth, "--class-map", mine)
    assert result.exit_code == 0, result.stderr
    assert "class map mine: there is no class 'xyzzy' of the run, 'stucco' of the truth." in result.stderr
    assert json.loads((run / "evaluation" / "evaluation.json").read_text())["labels"]["matching"] == "by mine"
    mine.write_text('[classes]\nxyzzy = "wall"\n')
    refused = invoke("evaluate", run, "--truth", finished_run.truth, "--class-map", mine)
    assert refused.exit_code == 1
    assert "mine: joins none of the run's classes" in refused.stderr


def test_changed_setting_then_ctrl_c(finished_run: FinishedRun, copied_run: Callable[[str], Path]) -> None:
    run = copied_run("run.msgs")
    assert states(run) == dict.fromkeys(("frames", "tracking", *LATER), "done")
    snapshot = run / "mapping.partial" / "snapshot" / "submaps_1" / "made_state_0000.safetensors"
    stopped = interrupt_when(
        snapshot.exists, "resume", run, "--set", "mapping.hold_out=4", "--set", "mapping.min_iterations=4000"
    )
    assert stopped.returncode == 130
    assert f"msgs-slam resume {run}" in stopped.stderr

    assert list(RunFolder(run).records) == ["frames", "proxy", "tracking"]
    expected = {"frames": "done", "tracking": "done", "mapping": "interrupted"}
    assert states(run) == expected | {"global_ba": "outdated", "export": "outdated"}
    # The old map is not the map of these settings: whoever asks for one is told so, and nobody measures it.
    refused = invoke("export", run, "--only", "ply", "--to", run.parent / "out")
    assert refused.exit_code == 1
    assert f"msgs-slam resume {run}" in refused.stderr
    assert invoke("evaluate", run, "--truth", finished_run.truth).exit_code == 0
    figures = json.loads((run / "evaluation" / "evaluation.json").read_text())
    assert figures["images"] == {"missing": "mapping is not done; the last stage is tracking"}
    assert invoke("report", run).exit_code == 0
    assert "mapping.min_iterations" not in (run / "report.html").read_text().split("All settings")[0]

    settings = ["--set", "mapping.min_iterations=20"]
    assert invoke("resume", run, *settings, "-q").exit_code == 0
    assert states(run) == dict.fromkeys(("frames", "tracking", *LATER), "done")
    assert made_with(RunFolder(run)).mapping.hold_out == 4
    assert invoke("evaluate", run, "--truth", finished_run.truth).exit_code == 0
    held_out = json.loads((run / "evaluation" / "evaluation.json").read_text())["images"]["held out"]
    assert held_out["views"] == OPTIONS.frames // 4


def test_settings_asked_for_are_not_those_it_was_made_with(copied_run: Callable[[str], Path]) -> None:
    run = copied_run("run.msgs")
    assert invoke("resume", run, "--until", "frames", "--set", "mapping.hold_out=4", "-q").exit_code == 0
    assert "mapping was made with other settings than run.toml now has (mapping.hold_out=4)" in (
        invoke("status", run).stdout
    )
    assert made_with(RunFolder(run)).mapping.hold_out == 0
    assert invoke("report", run).exit_code == 0
    assert "mapping.hold_out" not in (run / "report.html").read_text().split("All settings")[0]


@pytest.mark.parametrize(
    "option", [("--depth", "files:/nowhere"), ("--intrinsics", "1,2"), ("--device", "cuda"), ("--set", "a.b=1")]
)
def test_refused_setting_does_not_stick(
    option: tuple[str, str], finished_run: FinishedRun, copied_run: Callable[[str], Path]
) -> None:
    if option[1] == "cuda" and __import__("torch").cuda.is_available():
        pytest.skip("there is a GPU")
    run = copied_run("run.msgs")
    before = {p: p.read_bytes() for p in (run / "run.toml", run / "manifest.json")}
    code = 2 if option[0] == "--set" else 1  # what there is not at all, and what cannot be used
    assert invoke("reconstruct", finished_run.video, "--out", run, *option).exit_code == code
    assert {p: p.read_bytes() for p in before} == before
    assert invoke("resume", run, "-q").exit_code == 0


def test_second_process_removes_nothing(tmp_path: Path, finished_run: FinishedRun) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    with locked(run):  # the first process has just begun: nothing but its lock is there
        with pytest.raises(InputError, match="another msgs-slam process"):
            reconstruct(finished_run.video, run, Config(), SilentProgress())
        assert run.root.exists()
    # A process that could not begin removes what it has made; not so a folder that was there.
    with pytest.raises(InputError), locked(RunFolder(tmp_path / "new")):
        raise InputError("no")
    assert not (tmp_path / "new").exists()
    with pytest.raises(InputError), locked(run):
        raise InputError("no")
    assert run.root.exists()
