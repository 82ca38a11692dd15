"""A process killed at any call that changes the disk, from a stage's last line to the next one's first: the finished
stage survives, and nothing half-written is taken for it."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from msgs_slam.formats.errors import DiskFullError
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.run.ending import RECORD, discard, empty
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from tests.pipelines.run.recorder import Recorder

CALLS = ("replace", "rename", "unlink", "rmdir", "mkdir", "fsync", "open")
KILLED = 99
OTHER = "mapping.hold_out=4"


def bring(
    root: Path, config: Config | None = None, at_end: Callable[[], None] = lambda: None, **changes: Any
) -> list[str]:
    """Up to mapping, whose last line is `at_end`; which stages ran."""
    recorder = Recorder(at_end)
    stages = [replace(stage, **changes) for stage in recorder.stages()]
    return recorder.bring(root, config, until="mapping", stages=stages)


def contents(root: Path) -> dict[str, bytes]:
    """Of every file but the manifest, which holds times."""
    files = [p for p in root.rglob("*") if p.is_file() and p.name != "manifest.json"]
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in files}


def killed_at(root: Path, config: Config, count: int) -> bool:
    """Whether a process that ends before the `count`-th call of CALLS, after mapping's last line, came so far."""
    if (child := os.fork()) == 0:
        left = [count]

        def dying(call: Callable[..., Any]) -> Callable[..., Any]:
            def wrapped(*words: Any, **more: Any) -> Any:
                left[0] -= 1
                if left[0] == 0:
                    os._exit(KILLED)
                return call(*words, **more)

            return wrapped

        def arm() -> None:
            for name in CALLS:
                setattr(os, name, dying(getattr(os, name)))

        try:
            bring(root, config, arm)
            os._exit(0)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, KILLED)
    return code == KILLED


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """A run whose mapping is made again with OTHER, and what it holds then."""
    root = tmp_path_factory.mktemp("finished") / "r"
    bring(root)
    other = shutil.copytree(root, root.with_name("other"))
    bring(other, load_config(overrides=[OTHER]))
    return root, contents(other)


def test_a_kill_at_any_call_loses_no_finished_stage(finished: tuple[Path, dict[str, bytes]], tmp_path: Path) -> None:
    root, wanted = finished
    config, again, kills = load_config(overrides=[OTHER]), [], 0
    while True:
        copy = shutil.copytree(root, tmp_path / f"{kills}")
        if not killed_at(copy, config, kills + 1):
            break
        kills += 1
        run = RunFolder(copy)
        ended = any((folder / RECORD).exists() for folder in (run.partial("mapping"), run.stage("mapping")))
        known = "mapping" in run.records
        kept = (run.partial("mapping") / "snapshot" / "half.txt").exists()
        assert ended or known or kept
        ran = bring(copy, config)
        assert ran == ([] if ended or known else ["mapping"])
        assert contents(copy) == wanted
        assert not list(copy.glob("*.partial"))
        again.append(bool(ran))
    assert kills > 12
    assert again == sorted(again, reverse=True)  # once finished it stays so
    assert 0 < sum(again) < kills / 2


def interrupted(root: Path, monkeypatch: pytest.MonkeyPatch, *settings: str, **changes: Any) -> None:
    """Bring the first stage so far that its folder is sealed."""

    def stop(run: RunFolder, name: str) -> None:
        raise KeyboardInterrupt

    config = load_config(overrides=settings)
    with monkeypatch.context() as patch:
        patch.setattr("msgs_slam.pipelines.run.runner.move_in", stop)
        with pytest.raises(KeyboardInterrupt):
            bring(root, config, **changes)


def test_a_changed_file_or_other_work_is_not_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for change in ("a result", "the record", "settings", "nothing"):
        root = tmp_path / change
        interrupted(root, monkeypatch)
        (sealed,) = root.glob(f"*.partial/{RECORD}")
        if change == "a result":
            (sealed.parent / "folder" / "0.txt").write_text("other")
        if change == "the record":
            sealed.write_text(sealed.read_text()[:-20])
        config = load_config(overrides=["frames.rate=1"]) if change == "settings" else None
        ran = bring(root, config)
        assert ran == list(STAGES[:4])[change == "nothing" :]
        assert not list(root.rglob(RECORD))


def test_parts_of_another_size_are_not_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def division(run: RunFolder, config: Config) -> int:
        return len(run.file("frames", "folder/0.txt").read_text()) * config.run.memory_mb

    interrupted(tmp_path / "r", monkeypatch, "run.memory_mb=2100", division=division)
    shutil.copytree(tmp_path / "r", tmp_path / "s")
    same, other = (load_config(overrides=[f"run.memory_mb={mb}"]) for mb in (2100, 900))
    assert bring(tmp_path / "r", same, division=division)[0] == "proxy"
    assert bring(tmp_path / "s", other, division=division)[0] == "frames"


def test_a_disk_that_is_full_for_the_manifest_costs_no_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise DiskFullError("no room")

    def fill() -> None:
        monkeypatch.setattr("msgs_slam.pipelines.run.runner.write_manifest", full)

    with pytest.raises(DiskFullError):
        bring(tmp_path / "r", at_end=fill)
    monkeypatch.undo()
    assert list(RunFolder(tmp_path / "r").records) == ["frames", "proxy", "tracking"]
    assert bring(tmp_path / "r") == []
    assert not list(tmp_path.rglob(RECORD))


def test_files_that_a_network_disk_keeps_for_others_stop_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NFS renames a file that is removed while another process has it open, and its folder cannot be removed."""
    remove = shutil.rmtree

    def leaving(folder: Path, ignore_errors: bool = False) -> None:
        was_there = Path(folder).exists()
        remove(folder, ignore_errors)
        if was_there:
            Path(folder).mkdir()
            (Path(folder) / ".nfs0001").touch()

    bring(tmp_path / "r")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", leaving)
        assert bring(tmp_path / "r", load_config(overrides=[OTHER])) == ["mapping"]
        (tmp_path / "r" / "proxy" / "folder" / "0.txt").unlink()
        assert bring(tmp_path / "r", load_config(overrides=[OTHER])) == ["proxy"]
        empty(tmp_path / "r" / "proxy")
        assert not list((tmp_path / "r" / "proxy").iterdir())
    discard(tmp_path / "r" / "mapping")
    assert not list((tmp_path / "r").glob(".mapping*"))
