"""Processes that share the tasks of a run over its folder: each task once, whoever is killed, in any order."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import engine_calls
import pytest

from msgs_slam.formats import atomic
from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.engine import shards, workers
from msgs_slam.pipelines.engine.chunks import in_chunks
from msgs_slam.pipelines.engine.shards import Posted, Shard, SharedWorkers, posted_in
from msgs_slam.pipelines.engine.stages import Stage, StageContext, run_stages
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.names import STAGES
from msgs_slam.pipelines.system import values
from msgs_slam.pipelines.system.progress import SilentProgress

HOLDS = "import fcntl, sys; f = open(sys.argv[1], 'ab'); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of an unfinished stage; the tasks are those of the tests."""
    monkeypatch.setattr(values, "_OURS", "engine_calls")
    monkeypatch.setattr(shards, "TASK_MODULES", ("engine_calls",))
    (tmp_path / "proxy.partial").mkdir()
    return tmp_path / "proxy.partial"


def shared(index: int, count: int) -> SharedWorkers:
    return SharedWorkers(Shard(index, count), engine_calls.silent, 1)


@pytest.fixture
def helpers(folder: Path) -> Iterator[list[int]]:
    """Three that help until the test ends, and how many tasks each has done."""
    ended, done = threading.Event(), [0, 0, 0]

    def help_out(n: int) -> None:
        while not ended.is_set():
            done[n] += any(p.do_one(Shard(n + 1, 4), engine_calls.silent) for p in posted_in(RunFolder(folder.parent)))

    threads = [threading.Thread(target=help_out, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    yield done
    ended.set()
    for thread in threads:
        thread.join()


def test_every_task_is_done_once_and_comes_back_in_order(folder: Path, helpers: list[int]) -> None:
    tasks = [(folder / f"{n}", 2 * n) for n in range(24)]
    assert shared(0, 4).each(engine_calls.halve_noted, tasks, folder) == list(range(24))
    assert [len(path.read_text()) for path, _ in tasks] == [1] * 24
    assert not (folder.parent / ".tasks").exists()


def test_one_alone_does_all_whatever_its_share(folder: Path) -> None:
    assert shared(3, 16).each(engine_calls.halve, [6, 2], folder) == [3, 1]


def test_its_own_share_comes_first(folder: Path) -> None:
    posted = Posted.post(engine_calls.halve, list(range(0, 20, 2)), folder, 1)
    order = []
    while missing := posted.missing():
        assert posted.do_one(Shard(1, 4), engine_calls.silent)
        order += [n for n in missing if posted.done(n).exists()]
    assert order[:3] == [1, 5, 9]
    assert sorted(order) == list(range(10))


def test_what_a_killed_process_was_at_is_done_by_another(folder: Path) -> None:
    posted = Posted.post(engine_calls.halve, [4], folder, 1)
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(posted.folder / "0000.lock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    assert not posted.do_one(Shard(), engine_calls.silent)
    process.kill()
    process.wait()
    assert posted.do_one(Shard(), engine_calls.silent)
    assert values.load_value(posted.done(0)) == 2


def test_a_new_lead_waits_for_who_is_at_a_task_and_begins_anew(folder: Path) -> None:
    posted = Posted.post(engine_calls.halve_slowly, [8, 6], folder, 1)
    helper = threading.Thread(target=posted.do_one, args=(Shard(), engine_calls.silent))
    helper.start()
    while not list(posted.folder.glob("*.lock")):
        time.sleep(0.01)
    posted.withdraw()
    assert not posted.folder.exists() or not list(posted.folder.glob("*.done.npz"))
    helper.join(timeout=5)
    assert not helper.is_alive()
    assert not posted.do_one(Shard(), engine_calls.silent)
    shutil.rmtree(folder.parent / ".tasks", ignore_errors=True)
    assert shared(0, 2).each(engine_calls.halve, [8, 6], folder) == [4, 3]


def test_a_node_with_another_version_says_so_and_leaves_the_task(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    posted = Posted.post(engine_calls.halve, [4], folder, 1)
    with monkeypatch.context() as patch:
        patch.setattr(workers, "code_identity", lambda: "msgs-slam=another")
        with pytest.raises(RecoverableError, match="has another version of msgs-slam"):
            posted.do_one(Shard(), engine_calls.silent)
    assert posted.do_one(Shard(), engine_calls.silent)


def test_a_run_cannot_name_other_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "TASK_MODULES", ("msgs_slam.pipelines.proxy.stage",))
    posted = Posted.post(engine_calls.halve, [4], folder, 1)
    with pytest.raises(InputError, match="is not a task of this program"):
        posted.do_one(Shard(0, 1), engine_calls.silent)


def test_a_missing_file_inside_a_task_is_told_at_once(folder: Path) -> None:
    posted = Posted.post(engine_calls.read_missing, [folder / "nowhere.txt"], folder, 1)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        posted.do_one(Shard(), engine_calls.silent)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        shared(0, 2).each(engine_calls.read_missing, [folder / "nowhere.txt"], folder)
    assert (folder / "attempts").read_text() == "xx"


def test_two_that_end_the_same_task_without_locks_do_not_disturb_each_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one ends it between the last byte of this one's result and its renaming."""
    posted = Posted.post(engine_calls.halve_noted, [(folder / "0", 8)], folder, 1)
    replace, others = atomic.os.replace, []

    def interrupted(temporary: Path, path: Path) -> None:
        if not others and path == posted.done(0):
            others.append(temporary)
            with monkeypatch.context() as other:
                other.setattr(atomic, "process_mark", lambda: "of the other")
                posted._do_locked(0, posted._about(), engine_calls.silent)
        replace(temporary, path)

    monkeypatch.setattr(atomic.os, "replace", interrupted)
    assert posted.do_one(Shard(), engine_calls.silent)
    assert values.load_value(posted.done(0)) == 4
    assert others


def test_tasks_of_a_run_given_by_a_relative_path_can_be_done_from_elsewhere(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers have another working folder, on this machine or another."""

    class Elsewhere:
        at_once, threads = 2, 1

        def each(self, work: Callable[..., Any], tasks: Sequence[Any], folder: Path) -> list[Any]:
            monkeypatch.chdir(away)
            found = shared(0, 2).each(work, tasks, folder)
            monkeypatch.chdir(root)
            return found

    def run(context: StageContext) -> dict[str, Any]:
        return {"sum": sum(in_chunks(context, engine_calls.known_in_chunk, 6, number=7))}

    monkeypatch.setattr(values, "_OURS", "")
    (root := folder.parent / "here").mkdir()
    (away := folder.parent / "elsewhere").mkdir()
    monkeypatch.chdir(root)
    Path("run.msgs").mkdir()
    stages = [Stage(name, run) for name in STAGES[:1]]
    records = run_stages(
        stages, RunFolder(Path("run.msgs")), Path("v"), "d", Config(), SilentProgress(), STAGES[0], workers=Elsewhere()
    )  # fmt: skip
    assert records[STAGES[0]].figures == {"sum": 6 * 7}
    assert not list(away.iterdir())
