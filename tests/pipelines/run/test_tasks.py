"""Tasks of a stage: ranges that together are all, done here or by workers; their threads."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import Chunk, StageContext, in_chunks
from msgs_slam.pipelines.system.progress import Progress, SilentProgress
from msgs_slam.pipelines.system.threads import get_threads, limit_threads, set_threads
from tests.pipelines.travelling import Travelling


def numbers_in_chunk(chunk: Chunk, progress: Progress) -> tuple[list[int], str, object]:
    return list(chunk.numbers), chunk.known["text"], chunk.opened


@pytest.mark.parametrize("count", [0, 1, 4, 100])
@pytest.mark.parametrize("workers", [None, Travelling(1), Travelling(3)])
def test_chunks_are_all_things_in_order(count: int, workers: Travelling | None, tmp_path: Path) -> None:
    context = StageContext(RunFolder(tmp_path), tmp_path, Config(), tmp_path, SilentProgress(), workers=workers)
    found = in_chunks(context, numbers_in_chunk, count, "opened", text="known")
    assert [n for numbers, _, _ in found for n in numbers] == list(range(count))
    assert len(found) == (max(min(3 * workers.at_once, count), 1) if workers else 1)
    assert {(text, opened) for _, text, opened in found} == {("known", None if workers else "opened")}


@pytest.fixture
def threads_as_before() -> Iterator[None]:
    before = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits():
        yield
    torch.set_num_threads(before[0])
    cv2.setNumThreads(before[1])
    set_threads(0)


def test_libraries_take_the_threads_but_matrices_one(threads_as_before: None) -> None:
    """A matrix product on another number of threads has other last digits: results would depend on the machine."""
    threadpool_limits(2, "blas")
    limit_threads(3)
    assert (torch.get_num_threads(), cv2.getNumThreads(), get_threads()) == (3, 3, 3)
    found = [p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"]
    assert found
    assert set(found) == {1}
