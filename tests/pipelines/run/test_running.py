"""What `status` says while another process works on the run."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines import reconstruct
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.run import ending, progress
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import is_locked, locked
from msgs_slam.pipelines.run.progress import PROGRESS, RunProgress, load_run_progress
from msgs_slam.pipelines.run.stages import Stage, StageContext
from msgs_slam.pipelines.run.status import run_status
from msgs_slam.pipelines.system.progress import SilentProgress

States = list[tuple[str, ...]]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for n in range(2):
        write_rgb(tmp_path / "pictures" / f"{n}.png", np.full((8, 8, 3), 40 * n, np.uint8))
    return tmp_path / "pictures"


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> States:
    """What the table says: while half of tracking is done, and between its renaming and its record."""
    found: States = []

    def look(root: Path) -> None:
        found.append(tuple(s.state_text for s in run_status(RunFolder(root)).stages))

    def run(context: StageContext) -> dict[str, Any]:
        for n in context.progress.track(range(8), "poses"):
            if context.folder.name == "tracking.partial" and n == 4:
                look(context.run.root)
        return {}

    right = ending._flush_folder

    def flush(folder: Path) -> None:
        if (folder / "tracking").exists() and len(found) == 1:
            look(folder)
        right(folder)

    monkeypatch.setattr(ending, "_flush_folder", flush)
    monkeypatch.setattr(progress, "_BETWEEN_WRITES", 0.0)
    monkeypatch.setattr(reconstruct, "all_stages", lambda method: [Stage(name, run) for name in STAGES])
    return found


def test_the_stage_that_a_process_is_at_runs(seen: States, source: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    reconstruct.reconstruct(source, run, Config(), SilentProgress())
    at_half, renamed = seen
    assert at_half[:2] == renamed[:2] == ("done", "done")
    assert at_half[2].startswith("running, poses 50%")
    assert renamed[2].startswith("running")
    assert set(at_half[3:]) == set(renamed[3:]) == {"not yet"}
    assert {s.state for s in run_status(run).stages} == {"done"}
    assert not (run.root / PROGRESS).exists()


def test_what_a_killed_process_has_noted_does_not_run(seen: States, source: Path, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    reconstruct.reconstruct(source, run, Config(), SilentProgress(), until="frames")
    run.partial("proxy").mkdir()
    (run.root / PROGRESS).write_text('{"stage": "proxy", "label": "depth", "done": 3, "of": 4, "left": 240.0}')
    assert [s.state_text for s in run_status(run).stages[:2]] == ["done", "interrupted"]
    with locked(run):
        assert load_run_progress(run) == RunProgress("proxy", "depth", 3, 4, 240.0)
        assert run_status(run).stages[1].state_text == "running, depth 75%, about 4 min left"
        (run.root / PROGRESS).write_text("{")
        assert run_status(run).stages[1].state == "interrupted"
    assert not is_locked(run)
    shutil.rmtree(run.root)
    assert not is_locked(run)
