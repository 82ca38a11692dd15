"""The script for plug-ins of trainers, from the page on extending: started as such a program would start it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pycolmap
from cli_runs import FinishedRun

from msgs_slam.formats.datasets import open_sequence

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "examples" / "video_to_dataset.py"


def start(*words: object, until_closed: bool = False) -> tuple[int, list[dict[str, Any]]]:
    """The exit code, and what it has said; its stdin is open until the end, or closed from the beginning."""
    process = subprocess.Popen(
        [sys.executable, SCRIPT, *map(str, words)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
    )
    assert process.stdin is not None
    assert process.stdout is not None
    if until_closed:
        process.stdin.close()
    lines = [json.loads(line) for line in process.stdout]
    process.wait()
    process.stdin.close()
    process.stdout.close()
    return process.returncode, lines


def test_a_video_becomes_a_data_set(finished_run: FinishedRun, tmp_path: Path) -> None:
    shutil.copytree(finished_run.folder, tmp_path / "set.msgs")  # only its export has to be made again
    settings = tmp_path / "set.msgs" / "run.toml"
    settings.write_text(settings.read_text().replace("voxel = 0.05", "voxel = 0.06"))
    code, lines = start(finished_run.video, tmp_path / "set", "--depth")
    assert code == 0, lines
    assert lines[-1]["event"] == "done"
    found = open_sequence(tmp_path / "set", "nerfstudio")
    assert len(found) == lines[-1]["images"] > 5
    assert found.world_from_cam is not None
    assert (found.depth(0) > 0).mean() > 0.5
    assert pycolmap.Reconstruction(tmp_path / "set" / "sparse" / "0").num_points3D() > 100
    assert {line["stage"] for line in lines if line["event"] == "progress"} == {"files"}


def test_it_says_why_it_failed_and_that_it_was_cancelled(finished_run: FinishedRun, tmp_path: Path) -> None:
    code, lines = start(tmp_path / "none.mp4", tmp_path / "set")
    assert (code, [line["event"] for line in lines]) == (1, ["failed"])
    assert "no such file" in lines[0]["message"]
    code, lines = start(finished_run.video, tmp_path / "set", until_closed=True)
    assert (code, lines[-1]) == (2, {"event": "cancelled"})
    assert not (tmp_path / "set").exists()
