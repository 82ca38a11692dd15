"""The commands of the ten-minute tour, run on a tiny finished run; those that make one are run by other tests."""

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runs import FinishedRun, invoke

from msgs_slam.pipelines.viewer.camera_path import CameraPath, Keyframe

TOUR = Path(__file__).resolve().parents[2] / "docs" / "tour.md"
MADE_ELSEWHERE = {"reconstruct", "resume", "demo", "view", "doctor", "models"}


def test_the_tour_can_be_followed(finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(finished_run.folder, tmp_path / "video.msgs")
    (tmp_path / "DATASET").symlink_to(finished_run.truth)
    shutil.copyfile(finished_run.folder / "export" / "point_cloud.ply", tmp_path / "scene.ply")
    start, end = (Keyframe(np.eye(4), 60.0) for _ in range(2))
    (tmp_path / "video-path.json").write_text(CameraPath((start, end), seconds_per_keyframe=0.2).to_json())
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^msgs-slam (.*)$", TOUR.read_text(encoding="utf-8"), flags=re.MULTILINE)
    followed = [words for line in lines if (words := shlex.split(line, comments=True))[0] not in MADE_ELSEWHERE]
    assert {words[0] for words in followed} == {"status", "report", "render", "export", "evaluate"}
    for words in followed:
        done = invoke(*words)
        assert done.exit_code == 0, (words, done.output)
    made = ("out.mp4", "elsewhere/point_cloud.spz", "video.msgs/report.html", "video.msgs/evaluation/evaluation.json")
    assert [name for name in made if not (tmp_path / name).exists()] == []
