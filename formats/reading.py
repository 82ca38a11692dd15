"""The door through which bytes from outside come in: what is opened, how much of it, and what its damage is called."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from .errors import InputError

_LFS_POINTER = b"version https://git-lfs"
_MOST_OF_A_REASON = 200
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def reaching(path: Path) -> Iterator[None]:
    """Around looking at a path, or into a folder: what the system refuses there becomes an InputError, which names the
    path that the system names."""
    try:
        yield
    except OSError as error:
        raise _unreachable(error, path) from error


def _unreachable(error: OSError, path: Path) -> InputError:
    named = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else path
    if isinstance(error, FileNotFoundError):
        return InputError(f"no such file: {named}: check the spelling, and that the disk is mounted")
    if isinstance(error, PermissionError):
        return InputError(f"cannot read {named}: permission denied: change its rights or copy it")
    return InputError(f"cannot read {named}: {error.strerror or error}: check the path and the disk")


def home_expanded(text: str | Path) -> Path:
    """The path with `~` or `~user` at its beginning replaced; as it is where there is no such user."""
    return Path(os.path.expanduser(text))


@contextmanager
def parsing(path: Path | str, what: str, advice: str = "copy or export it again") -> Iterator[None]:
    """Around code that takes a file's bytes apart, a library's above all: what it raises is the file's fault.

    Libraries report damage under every name there is (of zlib, of their own unpacking, AssertionError, MemoryError);
    a list of them is never whole. So only that call is in the block. InputErrors pass as they are.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        reason = lines[-1][:_MOST_OF_A_REASON]
        raise InputError(f"{path} is damaged or no {what} ({reason}): {advice}") from error


@contextmanager
def opened(path: Path, most: int | None = None, *, any_content: bool = False) -> Iterator[BufferedReader]:
    """A regular file, open for reading.

    Raises InputError when it is missing, may not be read, is larger than `most` bytes, or no file at all (a pipe or a
    device would be waited for or read without an end), and unless `any_content` when it is empty or a git-LFS pointer.
    """
    path = Path(path)
    with reaching(path):
        try:
            # Without O_NONBLOCK, opening a pipe waits for somebody to write.
            flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
            file = os.fdopen(os.open(path, flags), "rb")
        except ValueError as error:
            raise InputError(f"{str(path)!r} is no path: check the spelling") from error
        except IsADirectoryError:
            raise InputError(f"{path} is a folder, not a file") from None
    with file:
        with reaching(path):
            _require_kind(path, file, most)
            if not any_content:
                _require_content(path, file)
        try:
            yield file
        except OSError as error:
            # Of a read nothing is named; what names another file, or finds no room, is no fault of this one.
            if error.filename is None and error.errno not in _NO_ROOM:
                raise _unreachable(error, path) from error
            raise


def _require_kind(path: Path, file: BufferedReader, most: int | None) -> None:
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is no regular file but a device, a pipe or a folder: give a file")
    if most is not None and status.st_size > most:
        raise InputError(
            f"{path} is larger than expected ({status.st_size / 1e6:.0f} MB, at most {most / 1e6:.0f}): is it another "
            "file's name?"
        )


def _require_content(path: Path, file: BufferedReader) -> None:
    if os.fstat(file.fileno()).st_size == 0:
        raise InputError(f"{path} is empty (0 bytes): the copy or download did not finish, fetch it again")
    if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
        raise InputError(f"{path} is a git-LFS pointer, not the file itself: run `git lfs pull` in its repository")
    file.seek(0)


def require_file(path: Path, most: int | None = None) -> int:
    """The size in bytes of a file that can be opened, for libraries that open it themselves. Raises as `opened`."""
    with opened(path, most) as file:
        return os.fstat(file.fileno()).st_size


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """Read a whole file. Raises as `opened`."""
    with opened(path, most) as file:
        return file.read()
