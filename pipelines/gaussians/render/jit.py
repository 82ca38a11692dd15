"""Compiling the CPU kernels: how, and where the machine code is kept between runs."""

from __future__ import annotations

import functools
import hashlib
import os
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.extending import register_jitable

# No "nnan" or "ninf": comparisons with a NaN must stay what they are. "contract" lets a*b+c become one instruction.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile to machine code that runs without the GIL, cached on disk between runs."""
    directory = cache_directory()
    with _numba_cache_in(directory):
        compiled: Callable[..., Any] = numba.njit(nogil=True, cache=directory is not None, **_OPTIONS)(function)
        return compiled


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only kernels call: it becomes part of them, so it needs no way in from Python and no
    place in the cache, which would take a third of the time of compiling it."""
    called: Callable[..., Any] = register_jitable(no_cpython_wrapper=True, **_OPTIONS)(function)
    return called


@functools.cache
def cache_directory() -> Path | None:
    """Where compiled kernels are kept: the first writable of NUMBA_CACHE_DIR, the user's cache folder and a private
    folder in the system's temporary one; None, said once, if there is no such place.

    The name ends in a hash of this package's sources: numba looks only at the file of the function it compiles, and
    would go on using machine code into which an older version of another file is inlined.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "msgs-slam"
    name = f"renderer-{_source_hash()}"
    first = (Path(given) if given else home) / name
    if _is_private(first):
        return first
    second = Path(tempfile.gettempdir()) / f"msgs-slam-{os.getuid() if hasattr(os, 'getuid') else 'user'}-{name}"
    if _is_private(second):
        warnings.warn(f"cannot write to {first.parent}: compiled kernels are kept in {second}", stacklevel=3)
        return second
    warnings.warn(
        f"cannot write to {first.parent} nor {second.parent}: kernels are compiled at every start", stacklevel=3
    )
    return None


def _is_private(directory: Path) -> bool:
    """Makes the folder if need be; whether it can be written, is ours, and nobody else may write there.

    The cache is executable code: in a shared temporary folder another user could have put it there first.
    """
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


def _source_hash() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


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
