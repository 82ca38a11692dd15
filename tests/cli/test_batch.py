"""`msgs-slam batch`: many recordings, one table, a process each."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from msgs_slam.formats import atomic
from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.formats.images import write_rgb
from msgs_slam.msgs_cli.batch import _share
from msgs_slam.msgs_cli.main import main
from msgs_slam.msgs_cli.output import Output
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.reconstruct import (
    DONE,
    ELSEWHERE,
    FAILED,
    BatchItem,
    Job,
    find_recordings,
    reconstruct_one,
    write_table,
)
from msgs_slam.pipelines.run.cluster import run_in_processes
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.lock import locked
from msgs_slam.pipelines.run.settings import load_config, merge_settings
from msgs_slam.pipelines.system.progress import SilentProgress, Stopped, soft_stop
from tests.pipelines import task_calls
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


def reconstruct_here(recording: BatchItem, **settings: object) -> str:
    config = load_config(None, QUICK, merge_settings(Config(), settings, "test"))
    return reconstruct_one(Job(recording, config, "frames", 0, Output().task_progress), SilentProgress())


def test_what_another_process_works_on_is_left_to_it(recordings: Path, tmp_path: Path) -> None:
    walk = find_recordings(recordings, tmp_path)[1]
    with locked(RunFolder(walk.run)):
        assert reconstruct_here(walk) == ELSEWHERE
    assert not walk.failure_file.exists()
    walk.failure_file.write_text("of yesterday")
    assert reconstruct_here(walk, frames={"max_side": 200}) == DONE
    assert not walk.failure_file.exists()
    assert RunFolder(walk.run).settings().frames.max_side == 200


def test_a_lost_process_costs_itself_only(tmp_path: Path) -> None:
    """It is started once more."""
    for name in ("never", "once", "always"):
        (tmp_path / name).mkdir()
    tasks = [(tmp_path / "never", 0), (tmp_path / "always", 5), (tmp_path / "once", 1)]
    ended = dict(run_in_processes(task_calls.die, tasks))
    ended[0]()
    ended[2]()
    with pytest.raises(RecoverableError, match="its process was lost: ended by SIGKILL, for want of memory perhaps"):
        ended[1]()
    assert [len(list((tmp_path / name).iterdir())) for name in ("never", "once", "always")] == [1, 2, 2]
    with pytest.raises(RecoverableError, match="exit code 1"):
        next(run_in_processes(task_calls.fail, [3]))[1]()


def process_at(marker: Path) -> int:
    while not marker.exists():
        time.sleep(0.05)
    return int(marker.read_text())


def require_gone(process: int) -> None:
    for _ in range(400):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the child still works")


def test_a_signal_is_passed_on(tmp_path: Path) -> None:
    marker = tmp_path / "begun"
    thread = threading.Thread(target=lambda: (process_at(marker), os.kill(os.getpid(), signal.SIGINT)))
    thread.start()
    with pytest.raises(Stopped), soft_stop(lambda number: None):
        list(run_in_processes(task_calls.wait, [marker]))
    thread.join()
    require_gone(process_at(marker))


def test_a_killed_parent_leaves_no_process_behind(tmp_path: Path) -> None:
    marker = tmp_path / "begun"
    code = (
        "from msgs_slam.pipelines.run.cluster import run_in_processes\nfrom tests.pipelines import task_calls\n"
        f"from pathlib import Path\nlist(run_in_processes(task_calls.wait, [Path({str(marker)!r})]))\n"
    )
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    parent = subprocess.Popen([sys.executable, "-c", code], env=paths, stderr=subprocess.DEVNULL)
    process = process_at(marker)
    parent.kill()
    parent.wait()
    require_gone(process)


def test_shards_are_disjoint_and_together_all(recordings: Path, tmp_path: Path) -> None:
    everything = list(range(37))
    parts = [_share(None, None, f"{k}/16") for k in range(16)]  # type: ignore[arg-type]
    assert sorted(n for part in parts for n in everything[part]) == everything
    for wrong in ("16/16", "-1/4", "3", "a/b", "0/0"):
        refused = run_batch(recordings, tmp_path / "runs", "--shard", wrong)
        assert (refused.exit_code, "K from 0 to N - 1" in refused.stderr) == (2, True)


def test_recordings_of_one_name_have_runs_of_their_own(tmp_path: Path) -> None:
    for name in ("a.mp4", "a.mov", "a.mov.mp4", "b.mp4", "c.mp4", "C.mov", ".hidden.mp4x"):
        (tmp_path / name).write_bytes(b"x")
    found = find_recordings(tmp_path, tmp_path / "runs")
    assert [(r.name, r.run.name) for r in found] == [
        ("C.mov", "C.mov.msgs"), ("a.mov", "a.mov.msgs"), ("a.mov.mp4", "a.mov.mp4.msgs"), ("a.mp4", "a.mp4.msgs"),
        ("b", "b.msgs"), ("c.mp4", "c.mp4.msgs"),
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


def test_two_shards_write_the_table_at_the_same_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other one writes all of its table between the last byte of this one and its renaming."""
    replace, others = atomic.os.replace, []

    def interrupted(temporary: Path, path: Path) -> None:
        if not others:
            others.append(temporary)
            with monkeypatch.context() as other:
                other.setattr(atomic, "process_token", lambda: "of the other")
                write_table(tmp_path, [{"recording": "b", "state": DONE}])
        replace(temporary, path)

    monkeypatch.setattr(atomic.os, "replace", interrupted)
    write_table(tmp_path, [{"recording": "a", "state": DONE}])
    assert set(rows(tmp_path)) == {"a"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["batch.json", "batch.md"]


def test_wrong_settings_are_refused_before_anything(recordings: Path, tmp_path: Path) -> None:
    refused = run_batch(recordings, tmp_path / "runs", "--set", "frames.nonsense=1")
    assert refused.exit_code == 2
    assert "there is no setting frames.nonsense" in refused.stderr
    assert not (tmp_path / "runs").exists()
    assert run_batch(recordings, tmp_path / "runs", "--address", "x:1").exit_code == 2


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra [cluster]")
def test_ray_takes_the_recordings(recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
    found = run_batch(recordings, tmp_path / "runs", "--engine", "ray")
    assert found.exit_code == 1
    assert {name: row["state"] for name, row in rows(tmp_path / "runs").items()} == {
        "broken": FAILED, "walk": "unfinished (frames)",
    }  # fmt: skip
    assert "broken.mp4 is a text file" in (tmp_path / "runs" / "broken.failed.txt").read_text()
