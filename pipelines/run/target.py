"""Folders into which the program writes beside files of the user: what it wrote is listed in them, and only that is
replaced or removed.

Everything is written into a new folder first, and moved to its place when all of it is complete: an attempt that fails
or is killed changes nothing.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import psutil

from ...formats.atomic import explained, machine_token, process_token
from ...formats.errors import InputError
from ...formats.reading import file_sha256, is_plain_path
from ...formats.textfile import read_json_object, write_json

LIST = ".msgs-slam.json"
"""The list of the files that the program has written into a folder."""
_STAGED = ".msgs-slam-"
_NAMED = 3
"""Names in a message."""

Belongs = Callable[[str], bool]
"""Whether an entry of a folder, by its name, is one of those that are about to be written."""


class Written(NamedTuple):
    """A file that the program has written: its size, its checksum, and what it was made from, "" where that does not
    matter."""

    bytes: int
    sha256: str
    origin: str = ""


@dataclass(frozen=True)
class Target:
    """A folder to write into; `written` are the names of files and folders in it whose `path` was asked for.

    `overwrite`: files of others may be replaced. `origin`: what the files are made from, those of another origin do not
    stay beside them; "": any may stay.
    """

    folder: Path
    overwrite: bool = False
    origin: str = ""
    written: list[str] = field(default_factory=list)

    def path(self, name: str) -> Path:
        """Return the path to write a file or folder to."""
        if name not in self.written:
            self.written.append(name)
        return self.folder / name

    def require(self, belongs: Belongs) -> None:
        """Raise InputError where an entry that belongs to what will be written is not from this program, or was changed
        since, or files of another origin would stay, unless they may be overwritten."""
        listed = read_list(self.folder)
        entries = [entry for entry in _entries(self.folder) if belongs(entry.name)]
        if link := next((entry for entry in entries if entry.is_symlink() and entry.is_dir()), None):
            raise InputError(f"{link} is a link to a folder: name another place")
        if other := next((entry for entry in entries if not (entry.is_file() or entry.is_dir())), None):
            raise InputError(f"{other} is a device or a pipe, or a link to nothing: name a file that may be written")
        if self.overwrite:
            return
        if foreign := [e.name for e in entries if not all(_is_own(self.folder, f, listed) for f in _files(e))]:
            raise InputError(
                f"{self.folder} holds {_joined(foreign)}, which msgs-slam has not written or which was changed since: "
                "name another place, or add --overwrite to replace it"
            )
        if stale := self._of_another_origin(listed, belongs):
            raise InputError(
                f"{self.folder} holds {_joined(stale)}, made from another map: name another folder, or add --overwrite "
                "to remove it"
            )

    @contextmanager
    def replacing(self, belongs: Belongs) -> Iterator["Target"]:
        """Yield the target of an empty folder to write into; when the block ends well, its files are moved to their
        places, and what an earlier call has left of the names that belong to them, or of another origin, is removed.

        Raises InputError as `require` does, before the block and after it.
        """
        self.require(belongs)
        made = not self.folder.exists()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            staged = Path(tempfile.mkdtemp(prefix=f"{_STAGED}{process_token()}-", dir=self.folder))
        except OSError as error:
            raise explained(error, self.folder / LIST) from error
        try:
            _remove_left(self.folder)
            yield Target(staged)
            fresh = {entry.name for entry in staged.iterdir()}
            self.require(lambda name: belongs(name) or name in fresh)
            self._move_in(staged, belongs)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
            if made:
                with suppress(OSError):  # something was written into it
                    self.folder.rmdir()

    def _of_another_origin(self, listed: Mapping[str, Written], belongs: Belongs) -> list[str]:
        return [
            name
            for name, written in listed.items()
            if self.origin and written.origin not in ("", self.origin) and not belongs(_top(name))
        ]

    def _move_in(self, staged: Path, belongs: Belongs) -> None:
        fresh = [p.relative_to(staged).as_posix() for p in sorted(_files(staged))]
        if folder := next((self.folder / name for name in fresh if (self.folder / name).is_dir()), None):
            raise InputError(f"{folder} is a folder: name another place")
        listed = read_list(self.folder)
        stale = [name for name in listed if belongs(_top(name)) and name not in fresh]
        for name in stale + self._of_another_origin(listed, belongs):
            if _is_own(self.folder, self.folder / name, listed):
                _remove(self.folder, name)
            del listed[name]
        try:
            for name in fresh:
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                listed[name] = Written((staged / name).stat().st_size, file_sha256(staged / name), self.origin)
                os.replace(staged / name, self.folder / name)
        except OSError as error:
            raise explained(error, self.folder / name) from error
        finally:
            about = "Files that msgs-slam has written here: bytes, SHA-256 and origin. It replaces only these."
            write_json(self.folder / LIST, {"about": about, "files": dict(sorted(listed.items()))})


def read_list(folder: Path) -> dict[str, Written]:
    """Read which files the program has written into a folder, by relative path; none where there is no list, or a
    damaged one."""
    try:
        files = read_json_object(folder / LIST)["files"]
        return {
            n: Written(int(size), str(sha), str(origin)) for n, (size, sha, origin) in files.items() if is_plain_path(n)
        }
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return {}


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _files(entry: Path) -> Iterator[Path]:
    """Yield the entry itself, or all below it that is no folder; links are not followed."""
    if entry.is_symlink() or not entry.is_dir():
        yield entry
        return
    for below in entry.iterdir():
        yield from _files(below)


def _top(name: str) -> str:
    return name.partition("/")[0]


def _is_own(folder: Path, path: Path, listed: Mapping[str, Written]) -> bool:
    """Whether the file is listed, and as it was written."""
    written = listed.get(path.relative_to(folder).as_posix())
    if written is None or any(p.is_symlink() for p in (path, *path.parents) if folder in p.parents):
        return False
    return path.is_file() and path.stat().st_size == written.bytes and file_sha256(path) == written.sha256


def _remove(folder: Path, name: str) -> None:
    """Remove a file, and the folders that it leaves empty."""
    path = folder / name
    with suppress(OSError):
        path.unlink()
        for parent in path.parents:
            if parent == folder:
                break
            parent.rmdir()


def _remove_left(folder: Path) -> None:
    """Remove the folders that killed processes of this machine have left."""
    start = f"{_STAGED}{machine_token()}-"
    for entry in _entries(folder):
        process = entry.name.removeprefix(start).partition("-")[0]
        is_own = entry.name.startswith(start) and entry.is_dir() and process.isdecimal()
        with suppress(OverflowError):  # no process has such a number: the folder is of somebody else
            if is_own and not psutil.pid_exists(int(process)):
                shutil.rmtree(entry, ignore_errors=True)


def _joined(names: list[str]) -> str:
    tops = sorted({_top(name) for name in names})
    more = f" and {len(tops) - _NAMED} more" if len(tops) > _NAMED else ""
    return ", ".join(tops[:_NAMED]) + more
