"""How many threads the libraries take."""

from collections.abc import Iterator

import cv2
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from msgs_slam.pipelines.compute.threads import get_threads
from msgs_slam.pipelines.compute.threads import set_threads as set_render_threads
from msgs_slam.pipelines.engine.tasks import set_threads


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
