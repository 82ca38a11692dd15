"""Things of which a long recording has more than memory holds: made again when they are needed again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from threading import Lock
from typing import Generic, TypeVar, overload

from .memory import release_free_memory

T = TypeVar("T")


class LruSequence(Sequence[T], Generic[T]):
    """The values of `make` for 0 to `count` - 1, those used last kept while they need at most `room` bytes together.

    `make` gives the same value whenever it is called with the same number, so that nobody sees what is kept. May be
    asked from several threads.
    """

    def __init__(self, count: int, make: Callable[[int], T], size_of: Callable[[T], int], room: float) -> None:
        self._count, self._make, self._size_of, self._room = count, make, size_of, room
        self._kept: OrderedDict[int, T] = OrderedDict()
        self._used = 0
        self._lock = Lock()
        self._making: dict[int, Lock] = {}

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[i] for i in range(self._count)[index]]
        key = range(self._count)[index]  # raises IndexError, counts from the end
        with self._lock:
            making = self._making.setdefault(key, Lock())
        with making:  # this one alone: others are had meanwhile, and nobody makes it twice
            with self._lock:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    return self._kept[key]
            value = self._make(key)
            self.keep(key, value)
            return value

    def keep(self, index: int, value: T) -> None:
        """Take a value that is at hand, the one that `make` would make."""
        with self._lock:
            if index in self._kept:
                self._used -= self._size_of(self._kept.pop(index))
            self._kept[index] = value
            self._used += self._size_of(value)
            while self._used > self._room and len(self._kept) > 1:
                self._used -= self._size_of(self._kept.popitem(last=False)[1])

    def forget(self) -> None:
        """Keep nothing until it is asked for again: what comes now needs the memory."""
        with self._lock:
            self._kept.clear()
            self._used = 0
        release_free_memory()

    def part(self, numbers: range) -> LruSequence[T]:
        """Return a sequence of the values `numbers`, counted from 0, with a cache of its own."""
        return LruSequence(len(numbers), lambda i: self._make(numbers[i]), self._size_of, self._room)

    def changed(self, function: Callable[[int, T], T]) -> LruSequence[T]:
        """Return a sequence of `function`(number, value); takes over the cached values and the memory limit."""
        make = self._make
        other = LruSequence(self._count, lambda i: function(i, make(i)), self._size_of, self._room)
        while self._kept:
            key, value = self._kept.popitem(last=False)
            other._kept[key] = function(key, value)
        other._used, self._used = self._used, 0
        return other
