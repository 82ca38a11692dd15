"""Processes share the tasks of a run over its folder: each once, whoever is killed, in any order; their threads."""

import json
import platform
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import engine_calls
import pytest
import torch
from finished import note_finished
from threadpoolctl import threadpool_info, threadpool_limits

from msgs_slam.formats import atomic
from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.pipelines import reconstruct
from msgs_slam.pipelines.compute.threads import get_threads
from msgs_slam.pipelines.compute.threads import set_threads as set_render_threads
from msgs_slam.pipelines.config import STAGES, Config
from msgs_slam.pipelines.engine import tasks
from msgs_slam.pipelines.engine.runner import run_stages
from msgs_slam.pipelines.engine.stages import Stage, StageContext
from msgs_slam.pipelines.engine.tasks import Chunk, Shard, SharedWorkers, TaskBoard, boards_in, in_chunks, set_threads
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.values import load_value

HOLDS = "import fcntl, sys; f = open(sys.argv[1], 'ab'); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of an unfinished stage; the tasks are those of the tests."""
    monkeypatch.setattr(tasks, "name_of", lambda work: work.__name__)
    monkeypatch.setattr(tasks, "of_name", lambda name: getattr(engine_calls, name))
    monkeypatch.setattr(tasks, "TASK_MODULES", ("engine_calls",))
    (tmp_path / "proxy.partial").mkdir()
    return tmp_path / "proxy.partial"


@contextmanager
def allowed_bytes(count: int) -> Iterator[None]:
    """Of every file that this process writes."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def shared(index: int, count: int) -> SharedWorkers:
    return SharedWorkers(Shard(index, count), engine_calls.silent, 1)


@pytest.fixture
def helpers(folder: Path) -> Iterator[list[int]]:
    """Three that help until the test ends, and how many tasks each has done."""
    ended, done = threading.Event(), [0, 0, 0]

    def help_out(n: int) -> None:
        while not ended.is_set():
            done[n] += any(
                board.do_one(Shard(n + 1, 4), engine_calls.silent) for board in boards_in(RunFolder(folder.parent))
            )

    threads = [threading.Thread(target=help_out, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    yield done
    ended.set()
    for thread in threads:
        thread.join()


def test_every_task_is_done_once_and_comes_back_in_order(folder: Path, helpers: list[int]) -> None:
    given = [(folder / f"{n}", 2 * n) for n in range(24)]
    assert shared(0, 4).each(engine_calls.halve_noted, given, folder) == list(range(24))
    assert [len(path.read_text()) for path, _ in given] == [1] * 24
    assert not (folder.parent / ".tasks").exists()


def test_one_alone_does_all_whatever_its_share(folder: Path) -> None:
    assert shared(3, 16).each(engine_calls.halve, [6, 2], folder) == [3, 1]


def test_its_own_share_comes_first(folder: Path) -> None:
    board = TaskBoard.publish(engine_calls.halve, list(range(0, 20, 2)), folder, 1)
    order = []
    while missing := board.missing():
        assert board.do_one(Shard(1, 4), engine_calls.silent)
        order += [n for n in missing if board.done(n).exists()]
    assert order[:3] == [1, 5, 9]
    assert sorted(order) == list(range(10))


def test_what_a_killed_process_was_at_is_done_by_another(folder: Path) -> None:
    board = TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(board.folder / "0000.lock")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    assert not board.do_one(Shard(), engine_calls.silent)
    process.kill()
    process.wait()
    assert board.do_one(Shard(), engine_calls.silent)
    assert load_value(board.done(0)) == 2


def test_a_new_lead_waits_for_who_is_at_a_task_and_begins_anew(folder: Path) -> None:
    board = TaskBoard.publish(engine_calls.halve_slowly, [8, 6], folder, 1)
    helper = threading.Thread(target=board.do_one, args=(Shard(), engine_calls.silent))
    helper.start()
    while not list(board.folder.glob("*.lock")):
        time.sleep(0.01)
    board.retire()
    assert not board.folder.exists() or not list(board.folder.glob("*.done.npz"))
    helper.join(timeout=5)
    assert not helper.is_alive()
    assert not board.do_one(Shard(), engine_calls.silent)
    shutil.rmtree(folder.parent / ".tasks", ignore_errors=True)
    assert shared(0, 2).each(engine_calls.halve, [8, 6], folder) == [4, 3]


def test_a_task_that_would_write_elsewhere_is_refused(folder: Path, tmp_path: Path) -> None:
    run = RunFolder(folder.parent)
    for where in (tmp_path.parent, folder / ".." / "..", Path("/etc")):
        task = Chunk(run, tmp_path / "video.mp4", Config(), where, folder / "known.npz", 0, 1)
        board = TaskBoard.publish(engine_calls.halve, [task], folder, 1)
        with pytest.raises(InputError, match="outside of the run"):
            board.do_one(Shard(), engine_calls.silent)
        board.retire()
    board = TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    header = json.loads((board.folder / "ready.json").read_text())
    (board.folder / "ready.json").write_text(json.dumps(header | {"folder": ".."}))
    with pytest.raises(InputError, match="may lie outside"):
        board.do_one(Shard(), engine_calls.silent)


def test_boards_of_a_killed_leader_go_when_another_one_leads(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever command that is: workers would take tasks of a stage that has ended."""
    run = RunFolder(folder.parent)
    note_finished(run, [])
    TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    seen = []
    monkeypatch.setattr(reconstruct, "run_stages", lambda *_: seen.append(boards_in(run)))
    reconstruct.resume(run, SilentProgress())
    assert seen == [[]]


def test_a_node_with_another_version_says_so_and_leaves_the_task(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    board = TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    with monkeypatch.context() as patch:
        patch.setattr(tasks, "code_identity", lambda: "msgs-slam=another")
        with pytest.raises(RecoverableError, match="has another version of msgs-slam"):
            board.do_one(Shard(), engine_calls.silent)
    assert board.do_one(Shard(), engine_calls.silent)


def test_a_run_cannot_name_other_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "TASK_MODULES", ("msgs_slam.pipelines.proxy.stage",))
    board = TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    with pytest.raises(InputError, match="is not a task of this program"):
        board.do_one(Shard(0, 1), engine_calls.silent)


def test_a_missing_file_inside_a_task_is_told_at_once(folder: Path) -> None:
    board = TaskBoard.publish(engine_calls.read_missing, [folder / "nowhere.txt"], folder, 1)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        board.do_one(Shard(), engine_calls.silent)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        shared(0, 2).each(engine_calls.read_missing, [folder / "nowhere.txt"], folder)
    assert (folder / "attempts").read_text() == "xx"


def test_two_that_end_the_same_task_without_locks_do_not_disturb_each_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one ends it between the last byte of this one's result and its renaming."""
    board = TaskBoard.publish(engine_calls.halve_noted, [(folder / "0", 8)], folder, 1)
    replace, others = atomic.os.replace, []

    def interrupted(temporary: Path, path: Path) -> None:
        if not others and path == board.done(0):
            others.append(temporary)
            with monkeypatch.context() as other:
                other.setattr(atomic, "process_token", lambda: "of the other")
                board._do_locked(0, board._header(), engine_calls.silent)
        replace(temporary, path)

    monkeypatch.setattr(atomic.os, "replace", interrupted)
    assert board.do_one(Shard(), engine_calls.silent)
    assert load_value(board.done(0)) == 4
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


def test_a_full_disk_names_the_node_and_what_to_do(folder: Path) -> None:
    """Of a node that may write no more than a kilobyte."""
    board = TaskBoard.publish(engine_calls.fill_disk, [folder / "large.bin"], folder, 1)
    with allowed_bytes(1000), pytest.raises(RecoverableError) as refused:
        board.do_one(Shard(), engine_calls.silent)
    for part in (f"on the node {platform.node()}", "disk full", "free some space", "run the same command again"):
        assert part in str(refused.value)
    assert not list(folder.glob("*large*"))


def test_a_task_that_is_refused_says_so(folder: Path) -> None:
    with pytest.raises(RecoverableError, match=r"halve 1: on the node .*: 3 is odd"):
        shared(0, 1).each(engine_calls.halve, [3], folder)


def test_a_node_with_other_versions_is_named_with_what_differs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = tasks.code_identity()
    tasks.require_same_world([tmp_path], code)
    monkeypatch.setattr(tasks.platform, "node", lambda: "node-7")
    for name, other in (("torch", "torch=1.0"), ("Python", "Python=2.7.18"), ("msgs-slam", "msgs-slam=0")):
        theirs = " ".join(other if part.startswith(f"{name}=") else part for part in code.split())
        with pytest.raises(
            InputError, match=rf"the node node-7 has another version of {name} \(.*, not {other.partition('=')[2]}\)"
        ):
            tasks.require_same_world([tmp_path], theirs)
    with pytest.raises(InputError, match="the node node-7 has another version of msgs-slam"):  # of an earlier program
        tasks.require_same_world([tmp_path], "3f5a 99b1")


def test_a_folder_that_a_node_does_not_see_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks.platform, "node", lambda: "node-7")
    board = TaskBoard.publish(engine_calls.halve, [4], folder, 1)
    folder.rmdir()
    with pytest.raises(RecoverableError, match=f"halve 1: the node node-7 does not see {folder}"):
        board.do_one(Shard(), engine_calls.silent)


@pytest.fixture
def threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits():
        yield
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])
    set_render_threads(0)


def test_libraries_take_the_threads_but_matrices_one(threads_as_before: None) -> None:
    """A matrix product on another number of threads has other last digits: results would depend on the machine."""
    threadpool_limits(2, "blas")
    set_threads(3)
    assert (torch.get_num_threads(), cv2.getNumThreads(), get_threads()) == (3, 3, 3)
    found = [p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"]
    assert found
    assert set(found) == {1}
