"""Tasks of a run that processes elsewhere do."""

import platform
from pathlib import Path

import engine_calls
import pytest

from msgs_slam.formats.errors import InputError, RecoverableError
from msgs_slam.pipelines.engine import workers
from msgs_slam.pipelines.engine.engines import LocalEngine
from msgs_slam.pipelines.engine.workers import Workers

WORKERS = Workers(LocalEngine(), engine_calls.silent, 1)


def test_what_tasks_return_comes_back_in_order(tmp_path: Path) -> None:
    assert WORKERS.each(engine_calls.halve, [6, 2], tmp_path) == [3, 1]


def test_a_full_disk_names_the_node_and_what_to_do(tmp_path: Path) -> None:
    """Of a node that may write no more than a kilobyte; what the others do stays."""
    with pytest.raises(RecoverableError) as refused:
        WORKERS.each(engine_calls.fill_disk, [tmp_path / "large.bin"], tmp_path)
    for part in (f"on the node {platform.node()}", "disk full", "free some space", "run the same command again"):
        assert part in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_a_task_that_is_refused_says_so_and_how_to_go_on(tmp_path: Path) -> None:
    with pytest.raises(RecoverableError, match=r"halve 1: on the node .*: 3 is odd"):
        WORKERS.each(engine_calls.halve, [3], tmp_path)


def test_a_node_with_other_versions_is_named_with_what_differs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = workers.code_identity()
    workers.require_same_world([tmp_path], code)
    monkeypatch.setattr(workers.platform, "node", lambda: "node-7")
    for name, other in (("torch", "torch=1.0"), ("Python", "Python=2.7.18"), ("msgs-slam", "msgs-slam=0")):
        theirs = " ".join(other if part.startswith(f"{name}=") else part for part in code.split())
        with pytest.raises(
            InputError, match=rf"the node node-7 has another version of {name} \(.*, not {other.partition('=')[2]}\)"
        ):
            workers.require_same_world([tmp_path], theirs)
    with pytest.raises(InputError, match="the node node-7 has another version of msgs-slam"):  # of an earlier program
        workers.require_same_world([tmp_path], "3f5a 99b1")


def test_a_folder_that_a_node_does_not_see_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers.platform, "node", lambda: "node-7")
    refused, value = workers.work_here(
        engine_calls.halve, 4, "halve 1", engine_calls.silent, tmp_path / "run", 1, workers.code_identity()
    )
    assert value is None
    assert refused.startswith(f"the node node-7 does not see {tmp_path / 'run'}")
