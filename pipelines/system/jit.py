"""Compiling kernels: how, and where the machine code is kept between runs. The one way to numba in this project."""

import functools
import os
import re
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numba

from ...formats.reading import user_cache
from .identity import digest_of

F = TypeVar("F", bound=Callable[..., Any])
_IMPORT = re.compile(r"^\s*from (\.+)([\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
"""An import inside the project: these are relative."""


def kernel(function: F | None = None, **options: Any) -> Any:
    """Compile to machine code that runs without the GIL, cached on disk between runs.

    Floats are taken literally: none of numba's fastmath, for reordered sums have been seen to break equal bytes over
    thread counts; a division by zero gives an infinity or NaN, as in numpy. `options` are numba's, for example
    parallel=True. Used as @kernel or @kernel(parallel=True). With _nrt=False a kernel can make no arrays, and does not
    count who holds those that it is given and their parts: loops over short parts take half of the time.
    """
    if function is None:
        return functools.partial(kernel, **options)
    root = cache_root()
    # numba looks only at the file of the function that it compiles, and would go on using machine code into which an
    # older version of another file is inlined: the folder's name follows all files that this one imports.
    directory = None if root is None else root / digest_of(imported_files(Path(function.__code__.co_filename)))
    with _numba_cache_in(directory):
        return numba.njit(**{"nogil": True, "error_model": "numpy", "cache": root is not None, **options})(function)


def imported_files(file: Path) -> set[Path]:
    """Find the module and what it imports of this project, directly or not, without importing any of it."""
    found, waiting = set[Path](), [file.resolve()]
    while waiting:
        if (path := waiting.pop()) not in found:
            found.add(path)
            waiting += _direct_imports(path)
    return found


@functools.cache
def _direct_imports(path: Path) -> list[Path]:
    found: list[Path] = []
    for dots, below, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
        folder = path.parents[len(dots) - 1].joinpath(*filter(None, below.split(".")))
        found += [folder.with_suffix(".py"), *(folder / f"{name}.py" for name in re.findall(r"\w+", names))]
    return [file for file in found if file.is_file()]


@functools.cache
def cache_root() -> Path | None:
    """Return the folder of compiled kernels: the first writable of NUMBA_CACHE_DIR, the user's cache folder and a
    private folder in the system's temporary one; None, with a warning, if there is no such place."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    cache = user_cache()
    first = Path(given) / "kernels" if given else None if cache is None else cache / "msgs-slam" / "kernels"
    if first is not None and _is_private(first):
        return first
    second = Path(tempfile.gettempdir()) / f"msgs-slam-{os.getuid() if hasattr(os, 'getuid') else 'user'}-kernels"
    tried = "a home folder, which this user lacks" if first is None else str(first.parent)
    if _is_private(second):
        warnings.warn(f"cannot write to {tried}: compiled kernels are kept in {second}", stacklevel=3)
        return second
    warnings.warn(f"cannot write to {tried} nor {second.parent}: kernels are compiled at every start", stacklevel=3)
    return None


def _is_private(directory: Path) -> bool:
    """Make the folder if need be; whether it is ours alone: another user could have put machine code there first."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = directory.lstat()
        foreign = hasattr(os, "getuid") and (
            status.st_uid != os.getuid() or status.st_mode & (stat.S_IWOTH | stat.S_IWGRP)
        )
        if foreign or not stat.S_ISDIR(status.st_mode):
            return False
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


@contextmanager
def _numba_cache_in(directory: Path | None) -> Iterator[None]:
    """numba reads its cache setting when a function is decorated; other users of numba keep theirs."""
    config: Any = numba.config  # its settings are made at run time
    before = config.CACHE_DIR
    config.CACHE_DIR = str(directory or "")
    try:
        yield
    finally:
        config.CACHE_DIR = before
