"""Work on threads side by side: what releases the interpreter lock overlaps with what does not."""

import itertools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
R = TypeVar("R")
ABREAST = 2
"""Things of which each already has its loops on all threads: the second is there for what of the first has not."""


def parallel_map(function: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[R]:
    """`map` on threads, in order; at most a few results wait in memory."""
    items = iter(items)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        waiting = [pool.submit(function, item) for item in itertools.islice(items, 2 * max(1, threads))]
        while waiting:
            yield waiting.pop(0).result()
            waiting.extend(pool.submit(function, item) for item in itertools.islice(items, 1))


def abreast(function: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[R]:
    """`map`, in order, with `ABREAST` of them in work where there is more than one thread; none is begun before those
    are done that come `ABREAST` before it, so that no more than these need memory."""
    if threads < ABREAST:
        yield from map(function, items)
        return
    items = iter(items)
    with ThreadPoolExecutor(ABREAST) as pool:
        waiting = [pool.submit(function, item) for item in itertools.islice(items, ABREAST)]
        while waiting:
            result = waiting.pop(0).result()
            waiting.extend(pool.submit(function, item) for item in itertools.islice(items, 1))
            yield result


class Kept(Generic[K, R]):
    """The values of `make` for the keys asked for last, at most `most` of them; who asks for one that another thread
    is making waits for it. `make` may ask others of its kind, but not itself in a circle."""

    def __init__(self, make: Callable[[K], R], most: int) -> None:
        self._make, self._most = make, most
        self._kept: OrderedDict[K, Future[R]] = OrderedDict()
        self._lock = Lock()

    def __call__(self, key: K) -> R:
        with self._lock:
            value = self._kept.get(key)
            is_new = value is None
            if value is None:
                value = self._kept[key] = Future()
            self._kept.move_to_end(key)
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        if is_new:
            self._fill(key, value)
        return value.result()

    def _fill(self, key: K, value: Future[R]) -> None:
        try:
            value.set_result(self._make(key))
        except BaseException as error:
            with self._lock:  # asked for again it is tried again
                if self._kept.get(key) is value:
                    del self._kept[key]
            value.set_exception(error)
