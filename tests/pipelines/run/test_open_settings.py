"""What the settings leave open is decided where a process works, and stays open in the run for the next one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines import reconstruct
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.reconstruct import made_with
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import Stage, StageContext
from msgs_slam.pipelines.system.progress import SilentProgress


@dataclass(frozen=True)
class Three:
    """Workers of a cluster whose smallest node has three CPUs; no stage here has tasks for them."""

    threads: int = 3
    at_once: int = 1

    def each(self, work: Any, tasks: Any, folder: Path) -> list[Any]:
        return []


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """The device and the threads of every stage that has run."""
    found: list[tuple[str, int]] = []

    def run(context: StageContext) -> dict[str, Any]:
        found.append((context.device, context.threads))
        return {}

    monkeypatch.setattr(reconstruct, "all_stages", lambda method: [Stage(name, run) for name in STAGES])
    return found


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for n in range(2):
        write_rgb(tmp_path / "pictures" / f"{n}.png", np.full((8, 8, 3), 40 * n, np.uint8))
    return tmp_path / "pictures"


def with_gpu(monkeypatch: pytest.MonkeyPatch, there: bool) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: there)
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda: (9, 0))


def test_a_run_begun_on_a_gpu_goes_on_without_one(
    seen: list[tuple[str, int]], source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    with_gpu(monkeypatch, True)
    reconstruct.reconstruct(source, run, Config(), SilentProgress(), until="frames")
    with_gpu(monkeypatch, False)
    reconstruct.resume(run, SilentProgress())
    assert [device for device, _ in seen] == ["cuda", *["cpu"] * 5]
    assert run.settings().run == made_with(run).run == Config().run


def test_the_threads_of_a_cluster_are_not_those_of_the_run(
    seen: list[tuple[str, int]], source: Path, tmp_path: Path
) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    reconstruct.reconstruct(source, run, Config(), SilentProgress(), "frames", Three())
    reconstruct.resume(run, SilentProgress(), until="proxy")
    assert seen[0][1] == 3
    assert run.settings().run.threads == 0
    reconstruct.resume(run, SilentProgress(), load_config(None, ["run.threads=2"]), workers=Three())
    assert {threads for _, threads in seen[2:]} == {2}


def test_a_gpu_that_was_asked_for_and_is_not_there_is_refused(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_gpu(monkeypatch, False)
    with pytest.raises(InputError, match="finds no CUDA device"):
        reconstruct.reconstruct(
            source, RunFolder(tmp_path / "r"), load_config(None, ["run.device=cuda"]), SilentProgress()
        )
    assert not (tmp_path / "r").exists()
