"""A finished run of a tiny clip by the real stages, made once."""

import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_runs import OPTIONS, QUICK, FinishedRun, invoke

from msgs_slam.formats.video_streams import write_video
from tests.world import iter_clip, make_world, write_sequence


@pytest.fixture(scope="session", autouse=True)
def _signals_as_at_a_terminal() -> None:
    """A suite in the background (nohup, `&`) starts with SIGINT and SIGHUP ignored; its children would inherit that."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    root = tmp_path_factory.mktemp("finished")
    world = make_world(texel=0.02)
    frames = list(iter_clip(world, OPTIONS))
    truth = write_sequence(root / "truth", world, OPTIONS, frames)
    video = write_video(root / "room.avi", [f.rgb for f in frames], OPTIONS.fps)
    settings = [x for s in QUICK for x in ("--set", s)]
    done = invoke("reconstruct", video, "--out", root / "room.msgs", *settings, "-q")
    assert done.exit_code == 0, done.output
    return FinishedRun(video, truth, root / "room.msgs")


@pytest.fixture
def copied_run(finished_run: FinishedRun, tmp_path: Path) -> Callable[[str], Path]:
    """copied_run(name): a copy of the finished run to spoil."""
    return lambda name="run.msgs": shutil.copytree(finished_run.folder, tmp_path / name)
