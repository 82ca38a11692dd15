"""Tasks of a run that processes elsewhere do."""

from pathlib import Path

import engine_calls
import pytest

from formats.errors import RecoverableError
from pipelines.engines import LocalEngine
from pipelines.workers import Workers

WORKERS = Workers(LocalEngine(), engine_calls.silent, 1)


def test_what_tasks_return_comes_back_in_order(tmp_path: Path) -> None:
    assert WORKERS.each(engine_calls.halve, [6, 2], tmp_path) == [3, 1]


def test_a_task_that_is_refused_says_so_and_how_to_go_on(tmp_path: Path) -> None:
    with pytest.raises(RecoverableError, match="halve 1: 3 is odd"):
        WORKERS.each(engine_calls.halve, [3], tmp_path)
