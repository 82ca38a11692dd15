"""Work on threads side by side: in order, no more than asked for, and nothing made twice."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from msgs_slam.pipelines.system.parallel import LOOKAHEAD, LruCache, map_lookahead, parallel_map, read_ahead


class Crowd:
    """Counts how many are inside at once, each until there are as many as are awaited, or a moment has passed."""

    def __init__(self, awaited: int) -> None:
        self._awaited, self._inside, self.most = awaited, 0, 0
        self._change = threading.Condition()

    def __call__(self, item: int) -> int:
        with self._change:
            self._inside += 1
            self.most = max(self.most, self._inside)
            self._change.notify_all()
            self._change.wait_for(lambda: self.most >= self._awaited, timeout=5)
            self._inside -= 1
        return item * item


@pytest.mark.parametrize("map_", [parallel_map, map_lookahead])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order(map_, threads: int) -> None:  # type: ignore[no-untyped-def]
    assert list(map_(lambda x: x * x, range(9), threads)) == [x * x for x in range(9)]
    assert list(map_(lambda x: x, [], threads)) == []


def test_two_are_in_work_at_once_and_no_more() -> None:
    crowd = Crowd(LOOKAHEAD)
    assert list(map_lookahead(crowd, range(8), threads=16)) == [x * x for x in range(8)]
    assert crowd.most == LOOKAHEAD


def test_with_one_thread_each_is_done_when_it_is_asked_for() -> None:
    begun: list[int] = []

    def items() -> Iterator[int]:
        for item in range(5):
            begun.append(item)
            yield item

    results = map_lookahead(lambda x: x, items(), threads=1)
    assert next(results) == 0
    assert begun == [0]


@pytest.mark.parametrize("map_", [parallel_map, map_lookahead])
def test_an_error_comes_in_its_place(map_) -> None:  # type: ignore[no-untyped-def]
    results = map_(lambda x: 1 // (x - 2), range(5), 2)
    assert [next(results), next(results)] == [-1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)


@pytest.mark.parametrize("threads", [1, 2])
def test_what_is_read_ahead_comes_in_order_and_is_one_item_more(threads: int) -> None:
    made: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(5):
            made.append(number)
            yield number
        raise ValueError("no sixth")

    ahead = read_ahead(numbers(), threads)
    assert next(ahead) == 0
    if threads == 1:
        assert made == [0]
    assert next(ahead) == 1
    assert len(made) in ((2,) if threads == 1 else (2, 3))
    assert [next(ahead) for _ in range(3)] == [2, 3, 4]
    with pytest.raises(ValueError, match="no sixth"):
        next(ahead)


def test_the_next_item_is_made_while_one_is_used() -> None:
    began = threading.Event()

    def two() -> Iterator[int]:
        yield 1
        began.set()
        yield 2

    ahead = read_ahead(two(), 2)
    assert next(ahead) == 1
    assert began.wait(5)
    assert list(ahead) == [2]


def test_what_two_threads_ask_for_is_made_once() -> None:
    made: list[int] = []
    both = threading.Barrier(2)

    def make(key: int) -> int:
        made.append(key)
        return -key

    kept = LruCache(make, 4)

    def ask(_: int) -> list[int]:
        both.wait(5)
        return [kept(key) for key in range(4)]

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(ask, range(2))) == [[0, -1, -2, -3]] * 2
    assert sorted(made) == [0, 1, 2, 3]


def test_those_asked_for_last_are_kept() -> None:
    made: list[int] = []
    kept = LruCache(lambda key: made.append(key) or key, 2)
    for key in (1, 2, 1, 3, 1, 2):
        assert kept(key) == key
    assert made == [1, 2, 3, 2]


def test_what_could_not_be_made_is_tried_again() -> None:
    answers = iter([ValueError("not yet"), 7])

    def make(key: int) -> int:
        if isinstance(answer := next(answers), Exception):
            raise answer
        return answer

    kept = LruCache(make, 2)
    with pytest.raises(ValueError, match="not yet"):
        kept(1)
    assert [kept(1), kept(1)] == [7, 7]
