"""Work on threads side by side, and sequences of values that are made on demand and kept within a limit."""

from __future__ import annotations

import itertools
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from threading import Lock
from typing import Any, Generic, TypeVar, overload

from .machine import release_free_memory

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
R = TypeVar("R")
LOOKAHEAD = 2
"""Items in work at once. Each item is multithreaded itself; a second one fills the first one's serial gaps."""


def parallel_map(function: Callable[[T], R], items: Iterable[T], threads: int, begun: int = 0) -> Iterator[R]:
    """`map` on threads, in order; at most `begun` items (0: two a thread) are in work or wait in memory."""
    items, threads = iter(items), max(1, threads)
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(_submitted(pool, function, item) for item in itertools.islice(items, begun or 2 * threads))
        while waiting:
            result = waiting.popleft().result()
            waiting.extend(_submitted(pool, function, item) for item in itertools.islice(items, 1))
            yield result


def _submitted(pool: ThreadPoolExecutor, function: Callable[[T], R], item: T) -> Future[R]:
    """What is noted of this thread's work is noted of the pool's."""
    return pool.submit(copy_context().run, function, item)


def map_lookahead(function: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[R]:
    """`map`, in order, with `LOOKAHEAD` items in work where there is more than one thread: no more need memory."""
    return parallel_map(function, items, LOOKAHEAD, LOOKAHEAD) if threads >= LOOKAHEAD else map(function, items)


def read_ahead(items: Iterable[T], threads: int) -> Iterator[T]:
    """The items; where there is more than one thread, the next is made on another one while one of them is used."""
    if threads < LOOKAHEAD:
        return iter(items)
    source, end = iter(items), object()
    made: Iterator[Any] = parallel_map(lambda _: next(source, end), itertools.repeat(None), 1, 1)
    return itertools.takewhile(lambda item: item is not end, made)


class LruCache(Generic[K, R]):
    """The values of `make` for the keys asked for last, kept while their sizes add up to at most `room`.

    A thread that asks for a value that another is making waits for it. `make` may ask others of its kind, but not
    itself in a circle; what it raises is not kept.
    """

    def __init__(self, make: Callable[[K], R], room: float, size_of: Callable[[R], int] = lambda value: 1) -> None:
        self._make, self._size_of, self._room = make, size_of, room
        self._kept: OrderedDict[K, R] = OrderedDict()
        self._used = 0
        self._lock = Lock()
        self._making: dict[K, Lock] = {}

    def __call__(self, key: K) -> R:
        with self._lock:
            making = self._making.setdefault(key, Lock())
        with making:  # made once; other values are made meanwhile
            with self._lock:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    return self._kept[key]
            value = self._make(key)
            self.keep(key, value)
            return value

    def keep(self, key: K, value: R) -> None:
        """Take a value that is at hand, the one that `make` would make."""
        with self._lock:
            if key in self._kept:
                self._used -= self._size_of(self._kept.pop(key))
            self._kept[key] = value
            self._used += self._size_of(value)
            while self._used > self._room and len(self._kept) > 1:
                self._used -= self._size_of(self._kept.popitem(last=False)[1])

    def clear(self) -> None:
        """Keep nothing until it is asked for again."""
        with self._lock:
            self._kept.clear()
            self._used = 0

    def take_over(self, other: LruCache[K, R], function: Callable[[K, R], R]) -> None:
        """Keep `function`(key, value) of what the other keeps, which gives it up one by one."""
        while other._kept:
            key, value = other._kept.popitem(last=False)
            self._kept[key] = function(key, value)
        self._used, other._used = other._used, 0


class LruSequence(Sequence[T], Generic[T]):
    """The values of `make` for 0 to `count` - 1, those used last kept while they need at most `room` bytes together.

    `make` gives the same value whenever it is called with the same number. May be asked from several threads.
    """

    def __init__(self, count: int, make: Callable[[int], T], size_of: Callable[[T], int], room: float) -> None:
        self._count, self._make, self._size_of, self._room = count, make, size_of, room
        self._cache = LruCache(make, room, size_of)

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[i] for i in range(self._count)[index]]
        return self._cache(range(self._count)[index])  # raises IndexError, counts from the end

    def keep(self, index: int, value: T) -> None:
        """Take a value that is at hand, the one that `make` would make."""
        self._cache.keep(index, value)

    def forget(self) -> None:
        """Keep nothing until it is asked for again: what comes now needs the memory."""
        self._cache.clear()
        release_free_memory()

    def part(self, numbers: range) -> LruSequence[T]:
        """Return a sequence of the values `numbers`, counted from 0, with a cache of its own."""
        return LruSequence(len(numbers), lambda i: self._make(numbers[i]), self._size_of, self._room)

    def changed(self, function: Callable[[int, T], T]) -> LruSequence[T]:
        """Return a sequence of `function`(number, value); takes over the cached values and the memory limit."""
        make = self._make
        other = LruSequence(self._count, lambda i: function(i, make(i)), self._size_of, self._room)
        other._cache.take_over(self._cache, function)
        return other
