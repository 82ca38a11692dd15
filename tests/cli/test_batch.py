"""`msgs-slam batch`: many recordings, one table; `msgs-slam work`: the run of many processes is that of one."""

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from cli_runs import invoke
from click.testing import CliRunner, Result

from msgs_slam.formats import atomic
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.reading import file_sha256
from msgs_slam.msgs_cli.main import main
from msgs_slam.msgs_cli.options import chosen_config, option_words
from msgs_slam.pipelines import batch
from msgs_slam.pipelines.batch import DONE, ELSEWHERE, FAILED, Recording, find_recordings, reconstruct_one
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.engine.placement import Command, CommandResult
from msgs_slam.pipelines.engine.tasks import Shard
from msgs_slam.pipelines.read_config import load_config, merge_settings, with_absolute_paths
from msgs_slam.pipelines.run.folder import RunFolder, load_records, load_settings
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.pipelines.frames.conftest import QUICK, render, sideways


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short walk, a video that is none, and what is no recording at all."""
    folder = tmp_path_factory.mktemp("recordings")
    for i, pose in enumerate(sideways(12)):
        write_rgb(folder / "walk" / f"{i:02d}.jpg", render(*pose))
    (folder / "broken.mp4").write_bytes(b"no video" * 100)
    (folder / "notes.txt").write_text("of the day")
    (folder / "empty").mkdir()
    return folder


def run_batch(folder: Path, runs: Path, *more: str) -> Result:
    settings = [part for text in QUICK for part in ("--set", text)]
    arguments = ["batch", str(folder), "--out", str(runs), "--until", "frames", *settings, *more]
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


def rows(runs: Path) -> dict[str, dict[str, object]]:
    return {row["recording"]: row for row in json.loads((runs / "batch.json").read_text())}


def test_a_failure_costs_itself_only_and_a_second_call_does_what_is_left(recordings: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    first = run_batch(recordings, runs)
    assert first.exit_code == 1
    assert "1 of 2 recordings failed" in first.stderr
    found = rows(runs)
    assert set(found) == {"broken", "walk"}
    assert found["walk"]["state"] == "unfinished (frames)"  # as far as --until says
    assert found["broken"]["state"] == FAILED
    assert "broken.mp4" in str(found["broken"]["error"])
    assert "broken.mp4" in (runs / "broken.failed.txt").read_text()
    assert "| walk | unfinished (frames) |" in (runs / "batch.md").read_text()
    assert not (runs / "broken.msgs").exists()
    before = (runs / "walk.msgs" / "frames" / "frames.json").stat().st_mtime_ns
    half = run_batch(recordings, runs, "--shard", "1/2")  # broken is of the other one
    assert half.exit_code == 0
    assert (runs / "walk.msgs" / "frames" / "frames.json").stat().st_mtime_ns == before
    assert {name: row["state"] for name, row in rows(runs).items()} == {"broken": FAILED, "walk": "unfinished (frames)"}


def reconstruct_here(recording: Recording, **settings: object) -> str:
    def read(base: Config | None) -> Config:
        return load_config(None, QUICK, merge_settings(base or Config(), settings, "test"))

    return reconstruct_one(recording, read, SilentProgress(), "frames")


def test_what_another_process_works_on_is_left_to_it(recordings: Path, tmp_path: Path) -> None:
    walk = find_recordings(recordings, tmp_path)[1]
    with locked(RunFolder(walk.run)):
        assert reconstruct_here(walk) == ELSEWHERE
    assert not walk.failure_file.exists()
    walk.failure_file.write_text("of yesterday")
    assert reconstruct_here(walk, frames={"max_side": 200}) == DONE
    assert not walk.failure_file.exists()
    assert load_settings(RunFolder(walk.run)).frames.max_side == 200


class Failing:
    """A placement whose processes fail before they can say why, or have said it."""

    def __init__(self, is_reported: bool) -> None:
        self.is_reported, self.words = is_reported, []  # type: ignore[var-annotated]

    def run(self, commands: Sequence[Command]) -> Iterator[CommandResult]:
        for command in commands:
            self.words.append(command.words)
            yield CommandResult(command, "the node node-7 does not see the run", self.is_reported)


def test_a_process_that_could_not_say_why_has_it_written_for_it(recordings: Path, tmp_path: Path) -> None:
    walk = find_recordings(recordings, tmp_path)[1]
    placement = Failing(is_reported=True)
    assert batch.run_batch([walk], placement, ["-q"]) == [walk]
    assert placement.words == [
        ("msgs_slam", "batch", str(recordings), "--out", str(tmp_path), "--placed", "walk", str(walk.source), "-q")
    ]
    assert walk.failure_file.read_text() == "the node node-7 does not see the run\n"
    walk.failure_file.write_text("what the process said\n")
    assert batch.run_batch([walk], placement, []) == [walk]
    assert walk.failure_file.read_text() == "what the process said\n"
    assert batch.run_batch([walk], Failing(is_reported=False), []) == [walk]
    assert walk.failure_file.read_text() == "the node node-7 does not see the run\n"


def test_shards_are_disjoint_and_together_all() -> None:
    all_of_them = [Recording(str(i), Path(), Path()) for i in range(37)]
    parts = [Shard.parse(f"{k}/16").of(all_of_them) for k in range(16)]
    assert sorted((r for part in parts for r in part), key=lambda r: int(r.name)) == all_of_them
    for wrong in ("16/16", "-1/4", "3", "a/b", "0/0"):
        with pytest.raises(InputError, match="K from 0 to N - 1"):
            Shard.parse(wrong)


def test_recordings_of_one_name_have_runs_of_their_own(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.mov", "a.mov.mp4", "b.mp4", ".hidden.mp4x"):
        (tmp_path / name).write_bytes(b"x")
    found = find_recordings(tmp_path, tmp_path / "runs")
    assert [(r.name, r.run.name) for r in found] == [
        ("a.mov", "a.mov.msgs"), ("a.mov.mp4", "a.mov.mp4.msgs"), ("a.mp4", "a.mp4.msgs"), ("b", "b.msgs"),
    ]  # fmt: skip
    with pytest.raises(InputError, match="is not a folder"):
        find_recordings(tmp_path / "a.mp4", tmp_path)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="holds no video"):
        find_recordings(tmp_path / "none", tmp_path)


def test_damaged_recordings_are_listed_with_the_reason(recordings: Path, tmp_path: Path) -> None:
    folder, runs = tmp_path / "scans", tmp_path / "runs"
    folder.mkdir()
    (folder / "good").symlink_to(recordings / "walk")
    for name, files in {
        "moved": {"transforms.json": '{"fl_x": 100, "frames": [{"file_path": "gone/0.jpg"}]}'},
        "half_a_table": {"rgb.txt": "0.0 rgb/0.png\n"},  # of TUM, whose rgb/ was not copied
        "no_model": {"sparse/0/cameras.bin": "x"},
        "pointers": {f"{i}.jpg": "version https://git-lfs.github.com/spec/v1\noid sha256:00\n" for i in range(3)},
        "pointer": {"transforms.json": "version https://git-lfs.github.com/spec/v1\n", "images/0.jpg": "x"},
        "raw": {"0.dng": "x", "1.dng": "x"},
        "notes": {"of the day.txt": "sunny"},
        "other.run": {"manifest.json": "{}", "frames/0.jpg": "x"},
    }.items():
        for file, text in files.items():
            (folder / name / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / name / file).write_text(text)
    done = run_batch(folder, runs)
    assert done.exit_code == 1
    assert "6 of 7 recordings failed" in done.stderr
    assert "left out, no images and no data set directly in them: notes (1 in all)" in done.stderr
    found = rows(runs)
    assert found["good"]["state"] == "unfinished (frames)"
    errors = {name: str(row.get("error")) for name, row in found.items() if row["state"] == FAILED}
    assert set(errors) == {"moved", "half_a_table", "no_model", "pointers", "pointer", "raw"}
    assert all(str(folder / name) in text for name, text in errors.items())
    assert "git-LFS" in errors["pointer"]
    assert ".dng files are not supported" in errors["raw"]


def test_files_of_options_are_found_from_the_folder_of_any_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("masks", "maps", "labels"):
        (tmp_path / name).mkdir()
    for name in ("cam.json", "t.gpx", "poses.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "all.toml").write_text('[frames]\nposes = "poses.txt"\n')
    given = {"frames__masks": "masks", "frames__intrinsics": "cam.json#left", "export__gps": "t.gpx"}
    given |= {"proxy__depth": "files:maps", "run__device": "cpu", "run__quality": None, "proxy__semantics": None}
    overrides = ["proxy.semantics=files:labels", "frames.rate=3"]
    config = chosen_config(Path("all.toml"), overrides, given)
    words = option_words(given, overrides, config)
    (tmp_path / "node").mkdir()
    monkeypatch.chdir(tmp_path / "node")
    there = CliRunner().invoke(main, ["batch", ".", "--out", "runs", *words, "--config", "../all.toml"])
    assert "holds no video" in there.output
    sets = [word.removeprefix("--set=") for word in words if word.startswith("--set=")]
    rest = [word for word in words if not word.startswith("--set=")]
    assert rest == ["--device=cpu"]
    assert load_config(tmp_path / "all.toml", [*sets, "run.device=cpu"]) == with_absolute_paths_of(config, tmp_path)


def with_absolute_paths_of(config: Config, folder: Path) -> Config:
    with contextlib.chdir(folder):
        return with_absolute_paths(config)


def test_two_shards_write_the_table_at_the_same_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other one writes all of its table between the last byte of this one and its renaming."""
    replace, others = atomic.os.replace, []

    def interrupted(temporary: Path, path: Path) -> None:
        if not others:
            others.append(temporary)
            with monkeypatch.context() as other:
                other.setattr(atomic, "process_token", lambda: "of the other")
                batch.write_table(tmp_path, [{"recording": "b", "state": DONE}])
        replace(temporary, path)

    monkeypatch.setattr(atomic.os, "replace", interrupted)
    batch.write_table(tmp_path, [{"recording": "a", "state": DONE}])
    assert set(rows(tmp_path)) == {"a"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["batch.json", "batch.md"]


def test_wrong_settings_are_refused_before_anything(recordings: Path, tmp_path: Path) -> None:
    refused = run_batch(recordings, tmp_path / "runs", "--set", "frames.nonsense=1")
    assert refused.exit_code == 2
    assert "there is no setting frames.nonsense" in refused.stderr
    assert not (tmp_path / "runs").exists()
    assert run_batch(recordings, tmp_path / "runs", "--address", "x:1").exit_code == 2


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")
def test_ray_places_a_process_for_each_recording(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
    found = run_batch(recordings, tmp_path / "runs", "--engine", "ray")
    assert found.exit_code == 1
    assert {name: row["state"] for name, row in rows(tmp_path / "runs").items()} == {
        "broken": FAILED, "walk": "unfinished (frames)",
    }  # fmt: skip
    assert "broken.mp4 is a text file" in (tmp_path / "runs" / "broken.failed.txt").read_text()


DIVIDED = ("--set", "mapping.submap=5", "--until", "mapping", "-q")


def contents(run: Path) -> dict[str, str]:
    files = (p for p in sorted((run / "mapping").rglob("*")) if p.is_file())
    return {str(p.relative_to(run)): file_sha256(p) for p in files}


def test_two_shards_at_a_time_leave_what_one_process_does(copied_run: Callable[[str], Path]) -> None:
    """One process alone, of a share that has no task, and then two at the same time."""
    whole, alone, both = copied_run("whole.msgs"), copied_run("alone.msgs"), copied_run("both.msgs")
    assert invoke("resume", whole, *DIVIDED).exit_code == 0
    for run in (alone, both):
        assert invoke("resume", run, "--set", "mapping.submap=5", "--until", "tracking", "-q").exit_code == 0
    found = invoke("work", alone, "--shard", "15/16", "--until", "mapping", "-q")
    assert found.exit_code == 0, found.stderr
    command = [sys.executable, "-m", "msgs_slam", "work", str(both), "--until", "mapping", "-q", "--shard"]
    processes = [subprocess.Popen([*command, f"{k}/2"]) for k in range(2)]
    assert [p.wait(timeout=300) for p in processes] == [0, 0]
    assert load_records(RunFolder(whole))["mapping"].figures["submaps"] == 3
    assert contents(whole) == contents(alone) == contents(both)
    assert not (alone / ".tasks").exists()


def test_what_cannot_be_is_refused(finished_run: object, tmp_path: Path) -> None:
    assert "K from 0 to N - 1" in invoke("work", finished_run.folder, "--shard", "3/3").stderr  # type: ignore[attr-defined]
    missing = invoke("work", tmp_path, "--shard", "0/3")
    assert missing.exit_code == 1
    assert "is not a run folder" in missing.stderr
