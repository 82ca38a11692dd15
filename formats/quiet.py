"""Warnings of libraries that say nothing to the user."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_FILTERS = Lock()


@contextmanager
def ignored_warnings(message: str = "", category: type[Warning] = Warning) -> Iterator[None]:
    """Ignore warnings of a category whose text begins with a pattern, in this block.

    The filters are the process's own: two threads that put back what each of them found would leave them changed, so
    one block at a time does it. Keep it short.
    """
    with _FILTERS, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message, category)
        yield
