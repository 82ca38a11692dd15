"""Tasks of a run that processes elsewhere do."""

import platform
from pathlib import Path

import engine_calls
import pytest

from formats.errors import RecoverableError
from pipelines.engines import LocalEngine
from pipelines.workers import Workers

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
