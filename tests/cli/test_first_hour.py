"""What somebody types in the first hour works, as the tour's commands do, or the message says what was meant."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from cli_runs import FinishedRun, invoke

from msgs_slam.formats.datasets import FORMATS
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import RunConfig

COMMAND = [sys.executable, "-m", "msgs_slam"]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "room.mp4"
    path.write_bytes(b"no video")
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--device", "gpu"], "--device is one of auto, cpu, cuda; got 'gpu'; did you mean cuda?"),
        (["--format", "video"], "did you mean images?"),
        (["--camera", "fish-eye"], "--camera is one of auto, perspective, equirectangular, fisheye"),
        (["--set", "run.device=gpu"], "did you mean cuda?"),
        (["--hold-out", "1"], "--hold-out is 2 to 1000000, or 0; got 1"),
        (["--devise", "cpu"], "--device"),
    ],
)
def test_a_typo_ends_with_2_in_the_words_that_were_typed(words: list[str], said: str, video: Path) -> None:
    result = invoke("reconstruct", video, "-o", video.parent / "run", *words)
    assert result.exit_code == 2
    assert said in result.stderr
    assert "run.device=" not in result.stderr or "--set" in words


def test_formats_of_the_setting_are_those_that_can_be_opened() -> None:
    choices = RunConfig.__dataclass_fields__["format"].metadata["choices"]
    assert set(choices) == {*FORMATS, "images"}


def test_an_address_is_to_be_downloaded_first(tmp_path: Path) -> None:
    result = invoke("reconstruct", "https://example.com/video.mp4", "-o", tmp_path / "run")
    assert result.exit_code == 1
    assert "download it first" in result.stderr


def test_where_a_run_is_beside_what_was_named(
    copied_run: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copied_run("room.msgs")
    (tmp_path / "room.mp4").write_bytes(b"video")
    for named in (tmp_path, tmp_path / "room.mp4", tmp_path / "room", run / "export"):
        for command in ("status", "report"):
            result = invoke(command, named)
            assert result.exit_code == 1
            assert f"did you mean {run}?" in result.stderr, named
    monkeypatch.chdir(tmp_path)
    assert "did you mean room.msgs?" in invoke("status", "videos/room.mp4").stderr


def test_a_network_is_named_as_it_is_listed(
    finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    words = ("reconstruct", finished_run.video, "-o", tmp_path / "run", "--depth")
    known = invoke(*words, "metric3d-small")
    assert known.exit_code == 1
    assert "msgs-slam models pull metric3d-small" in known.stderr
    near = invoke(*words, "metric3d")
    assert near.exit_code == 2
    assert "there is no provider or model 'metric3d'; did you mean metric3d-small?" in near.stderr
    assert "onnx:CARD.toml, or its name" in invoke(*words, "onnx").stderr


def test_every_command_is_in_the_overview() -> None:
    text = invoke("--help").stdout
    overview = text[: text.index("Options:")]
    assert [name for name in main.commands if f"msgs-slam {name}" not in overview] == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete(shell: str) -> None:
    script = invoke("completion", shell).stdout
    assert "_MSGS_SLAM_COMPLETE" in script
    environment = os.environ | {
        "_MSGS_SLAM_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": "msgs-slam rec",
        "COMP_CWORD": "rec" if shell == "fish" else "1",  # fish gives the word itself
    }
    command = [str(Path(sys.executable).with_name("msgs-slam"))]
    said = subprocess.run(command, env=environment, capture_output=True, text=True).stdout
    assert "reconstruct" in said


def test_a_device_for_resume_and_demo(copied_run: Callable[[str], Path], tmp_path: Path) -> None:
    assert invoke("resume", copied_run("run.msgs"), "--device", "cpu", "-q").exit_code == 0
    wrong = invoke("demo", "-o", tmp_path / "demo", "--device", "gpu")
    assert wrong.exit_code == 2
    assert not (tmp_path / "demo").exists()


def test_render_draws_colour_for_a_browser_in_the_size_that_is_asked_for(
    finished_run: FinishedRun, tmp_path: Path
) -> None:
    for option in ("--kind", "--path", "--fps"):
        about = invoke("render", "--help").stdout.split(f"  {option}")[1].split("  --")[0]
        assert "default:" in about.lower(), option
    made = tmp_path / "walk.mp4"
    result = invoke("render", finished_run.folder, made, "--fps", "3", "--size", "96x64")
    assert result.exit_code == 0, result.stderr
    capture = cv2.VideoCapture(str(made))
    assert (capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (96, 64)
    code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    assert code in ("h264", "avc1", "vp09")
    assert re.search(r"rendering \d+ images: a film of \d+ s at 3 images a second", result.stderr)
    assert "name a video that ends in .mp4" in invoke("render", finished_run.folder, tmp_path / "walk.gif").stderr
    wrong = invoke("render", finished_run.folder, made, "--size", "96")
    assert wrong.exit_code == 2
    assert "1280x720" in wrong.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_signals_end_other_commands_without_a_stack_trace(
    number: signal.Signals, code: int, finished_run: FinishedRun, tmp_path: Path
) -> None:
    words = [*COMMAND, "render", str(finished_run.folder), str(tmp_path / "frames"), "--fps", "240"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list(tmp_path.glob("frames/*.png")):
        time.sleep(0.01)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert "stack trace" not in errors
    assert "Traceback" not in errors
    assert ("stopped by Ctrl-C" in errors) == (number == signal.SIGINT)


TOUR = Path(__file__).resolve().parents[2] / "docs" / "tour.md"
MADE_ELSEWHERE = {"reconstruct", "resume", "demo", "view", "doctor", "models"}


def test_the_tour_can_be_followed(finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(finished_run.folder, tmp_path / "video.msgs")
    (tmp_path / "DATASET").symlink_to(finished_run.truth)
    keyframe = {"position": [0, 0, 0], "rotation_wxyz": [1, 0, 0, 0], "fov_degrees": 60}
    path = {"format": "msgs-slam camera path 1", "world": "exported", "fps": 30, "seconds_per_keyframe": 0.2}
    (tmp_path / "video-path.json").write_text(json.dumps(path | {"keyframes": [keyframe, keyframe]}))
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^msgs-slam (.*)$", TOUR.read_text(encoding="utf-8"), flags=re.MULTILINE)
    followed = [words for line in lines if (words := shlex.split(line, comments=True))[0] not in MADE_ELSEWHERE]
    assert {words[0] for words in followed} == {"status", "report", "render", "export", "evaluate"}
    for words in followed:
        done = invoke(*words)
        assert done.exit_code == 0, (words, done.output)
    made = ("out.mp4", "elsewhere/point_cloud.spz", "video.msgs/report.html", "video.msgs/evaluation/evaluation.json")
    assert [name for name in made if not (tmp_path / name).exists()] == []
