"""The door for files and paths from outside: what is opened, how much of it, and what its damage is called."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path, PurePath

from .errors import InputError

LONGEST_NAME, _LONGEST_PATH = 255, 4000
"""Bytes that Linux takes for a part of a path, and a little less than it takes for the whole."""

_PATH_IN_NAME = re.compile(r"[/\\]|^[A-Za-z]:")
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Unicode's control characters, halves of pairs (so Python shows bytes that are no UTF-8), and line breaks."""

_LFS_POINTER = b"version https://git-lfs"
_MAX_REASON_CHARACTERS = 200
_JUST_WRITTEN = 2.0
"""Seconds."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


_noted: ContextVar[tuple[Callable[[Path], None], ...]] = ContextVar("_noted", default=())


@contextmanager
def on_each_read(call: Callable[[Path], None]) -> Iterator[None]:
    """Call a function with the path of each file that this thread opens, by `opened` and what is built on it, in the
    block: what an identity of the result has to cover."""
    token = _noted.set((*_noted.get(), call))
    try:
        yield
    finally:
        _noted.reset(token)


@contextmanager
def noting_files() -> Iterator[list[Path]]:
    """Yield a list of the files that are opened in the block, which `on_each_read` is not told of."""
    files: list[Path] = []
    token = _noted.set((files.append,))
    try:
        yield files
    finally:
        _noted.reset(token)


def note_read(path: Path) -> None:
    """Tell `on_each_read` of a file that a library opens itself, or of a folder whose names are read."""
    for call in _noted.get():
        call(path)


@contextmanager
def reaching(path: Path) -> Iterator[None]:
    """Turn what the system refuses in this block, which looks at a path or into a folder, into an InputError that names
    the path which the system names."""
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
    """Return the path with `~` or `~user` at its beginning replaced; as it is where there is no such user."""
    return Path(os.path.expanduser(text))


@contextmanager
def parsing(path: Path | str, what: str, advice: str = "copy or export it again") -> Iterator[None]:
    """Turn what is raised in this block, in which a library takes a file's bytes apart, into an InputError about the
    file.

    Libraries report damage under every name there is (of zlib, of their own unpacking, AssertionError, MemoryError);
    a list of them is never whole. So only that call is in the block. InputErrors pass as they are.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        reason = lines[-1][:_MAX_REASON_CHARACTERS]
        raise InputError(f"{path} is damaged or no {what} ({reason}): {advice}") from error


@contextmanager
def opened(path: Path, limit: int | None = None, *, any_content: bool = False) -> Iterator[BufferedReader]:
    """Open a regular file for reading.

    Raises InputError when it is missing, may not be read, is larger than `limit` bytes, or no file at all (a pipe or a
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
    note_read(path)
    with file:
        with reaching(path):
            _require_regular(path, file, limit, any_content)
        try:
            yield file
        except OSError as error:
            # Of a read nothing is named; what names another file, or finds no room, is no fault of this one.
            if error.filename is None and error.errno not in _NO_ROOM:
                raise _unreachable(error, path) from error
            raise


def _require_regular(path: Path, file: BufferedReader, limit: int | None, any_content: bool) -> None:
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is no regular file but a device, a pipe or a folder: give a file")
    if limit is not None and status.st_size > limit:
        raise InputError(
            f"{path} is larger than expected ({status.st_size / 1e6:.0f} MB, at most {limit / 1e6:.0f}): is it another "
            "file's name?"
        )
    if any_content:
        return
    if status.st_size == 0:
        raise InputError(f"{path} is empty (0 bytes): the copy or download did not finish, fetch it again")
    if file.read(len(_LFS_POINTER)) == _LFS_POINTER:
        raise InputError(f"{path} is a git-LFS pointer, not the file itself: run `git lfs pull` in its repository")
    file.seek(0)


def require_file(path: Path, limit: int | None = None) -> int:
    """Return the bytes of a file that can be opened, for libraries that open it themselves. Raises as `opened`."""
    with opened(path, limit) as file:
        return os.fstat(file.fileno()).st_size


def read_bytes(path: Path, limit: int | None = None) -> bytes:
    """Read a whole file. Raises as `opened`."""
    with opened(path, limit) as file:
        return file.read()


def is_unicode(text: str) -> bool:
    """Return whether a text can be written as UTF-8: names on disk that are no UTF-8 come as lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def require_unicode(path: Path) -> None:
    """Raise InputError for a path that no JSON or text file can hold."""
    if not is_unicode(str(path)):
        raise InputError(f"{path}: a name in this path is no valid UTF-8, as of an old disk or ZIP file. Rename it")


def require_listable(paths: Iterable[Path]) -> None:
    """Raise InputError for paths that a text file of one path a line cannot hold."""
    for path in paths:
        require_unicode(path.resolve())
        if "\n" in str(path.resolve()):
            raise InputError(f"{path}: a name in this path holds a line break: rename it")


def resolve_within(root: Path, relative: str, named_by: Path) -> Path:
    """Return `root / relative`, where `named_by` is the file that says so.

    Raises InputError when the name leads out of `root`, by `..` or as an absolute path: data from others must not
    reach into the rest of the disk. Links are followed, for people put data sets together from links, and what is found
    is only read; `resolve_own` is for folders that are written to.
    """
    name = Path(os.path.normpath(relative))  # so that no `..` is left that would be looked up behind a link
    try:
        long = len(os.fsencode(root / name)) > _LONGEST_PATH
        long = long or any(len(os.fsencode(part)) > LONGEST_NAME for part in name.parts)
    except ValueError:
        long = True  # half a character, which no path can hold
    if long or "\0" in relative or leads_out(name):
        raise InputError(f"{named_by} names the file {relative[:300]!r}, outside {root}: correct the entry")
    return root / name


def leads_out(name: PurePath) -> bool:
    """Return whether a normal path leads out of the folder that it is appended to: by a root, a drive or `..`."""
    return bool(name.anchor) or name.parts[:1] == ("..",)


def is_plain_name(name: str) -> bool:
    """Return whether a text names one entry of a folder, on every system: no path, no drive, no control character or
    line break, valid UTF-8 of at most 255 bytes."""
    return (
        name not in ("", ".", "..")
        and _PATH_IN_NAME.search(name) is None
        and not any(unicodedata.category(character) in _NOT_IN_NAMES for character in name)
        and len(name.encode("utf-8")) <= LONGEST_NAME
    )


def is_plain_path(relative: str) -> bool:
    """Return whether a text is a path of plain names (`is_plain_name`) with slashes between them."""
    return all(map(is_plain_name, relative.split("/")))


def resolve_own(root: Path, relative: str) -> Path:
    """Return `root / relative` in a folder that only this program fills, as a run, whoever it is from.

    Raises InputError for what is no plain path (`is_plain_path`), and where a part of it is a link: an unpacked archive
    may hold any, and what is written or removed behind it would be elsewhere on the disk.
    """
    if not is_plain_path(relative):
        raise InputError(f"{root} names the file {relative[:300]!r}, which may lie outside: use a copy that is whole")
    path = root
    for part in relative.split("/"):
        path = path / part
        require_no_link(path)
    return path


def require_no_link(path: Path) -> None:
    """Raise InputError for a link, whatever it leads to."""
    if path.is_symlink():
        raise InputError(f"{path} is a link, which may lead anywhere: put what it leads to in its place, or remove it")


def links_in(folder: Path) -> Iterator[Path]:
    """Yield the links below a folder, following none."""
    for path, folders, files in os.walk(folder):
        yield from (link for name in (*folders, *files) if (link := Path(path, name)).is_symlink())


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes. Raises InputError when it cannot be read."""
    with opened(path, any_content=True) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


_known_digests: dict[Path, tuple[FileStamps, str]] = {}


def known_sha256(path: Path) -> str:
    """Return `file_sha256`, taken once in this process for as long as the file's inode, size and times stay: videos are
    gigabytes. One that has just been written is read each time, for it may be written again at the same time of the
    clock."""
    if (known := _known_digests.get(path)) is None or not known[0].are_current():
        known = _known_digests[path] = (FileStamps.of([path]), file_sha256(path))
    return known[1]


@dataclass(frozen=True)
class FileStamps:
    """Files and folders with inode, size and times of each; None where one has just been written, and may be again at
    the same time of the clock."""

    stamps: Mapping[Path, tuple[int, ...]] | None

    @classmethod
    def of(cls, paths: Iterable[Path]) -> FileStamps:
        """Look at files and folders as they are."""
        try:
            found = {path: _stamp(path) for path in {*paths}}
        except OSError:
            return cls(None)
        newest = max(max(stamp[2:]) for stamp in found.values()) / 1e9
        return cls(None if time.time() - newest < _JUST_WRITTEN else found)

    def are_current(self) -> bool:
        """Return whether nothing has changed since."""
        try:
            return self.stamps is not None and all(_stamp(path) == stamp for path, stamp in self.stamps.items())
        except OSError:
            return False


def _stamp(path: Path) -> tuple[int, ...]:
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def files_sha256(
    named: Iterable[tuple[str, Path]], head: bytes = b"", of_file: Callable[[Path], str] = file_sha256
) -> str:
    """Hex SHA-256 over `head` and the names and contents of files, wherever they are, each digested by `of_file`.
    Raises as `file_sha256`."""
    digest = hashlib.sha256(head)
    for name, path in named:
        digest.update(f"{name}\0{of_file(path)}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def user_cache() -> Path | None:
    """Return the folder for what programs of this user can make again; None for a user without a home folder."""
    place = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return None if place.startswith("~") else Path(place)
