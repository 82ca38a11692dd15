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
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from ...formats.atomic import explained, machine_token, process_token
from ...formats.errors import InputError
from ...formats.reading import file_sha256
from ...formats.textfile import read_json_object, write_json
from ..system.wording import quoted

LIST = ".msgs-slam.json"
"""The list of the files that the program has written into a folder."""
STAGE = "stage"
"""Origin of the files that a stage has left in its folder."""
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
    """A folder to write into. `overwrite`: files of others may be replaced. `origin`: what the files are made from,
    those of another origin do not stay beside them; "": any may stay. `fixed`: files of a stage, (bytes, sha256) by
    relative path, which may be written with the same contents only."""

    folder: Path
    overwrite: bool = False
    origin: str = ""
    fixed: Mapping[str, tuple[int, str]] = field(default_factory=dict)

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
        fixed = {name: Written(*stamp, STAGE) for name, stamp in self.fixed.items()}
        if foreign := [e.name for e in entries if not all(_is_own(self.folder, f, fixed | listed) for f in _files(e))]:
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
    def replacing(self, belongs: Belongs) -> Iterator[Path]:
        """Yield an empty folder to write into; when the block ends well, its files are moved to their places, and what
        an earlier call has left of the names that belong to them, or of another origin, is removed.

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
            yield staged
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
        fresh = {p.relative_to(staged).as_posix(): _stamp(p) for p in sorted(_files(staged))}
        for name, stamp in fresh.items():
            if self.fixed.get(name, stamp) != stamp:
                raise InputError(
                    f"{self.folder / name} belongs to the run, and these settings or this version of the program write "
                    f"it otherwise: run `msgs-slam resume {quoted(self.folder.parent)} --redo export`, or name another "
                    "folder with --to"
                )
            if (self.folder / name).is_dir():
                raise InputError(f"{self.folder / name} is a folder: name another place")
        listed = read_list(self.folder)
        stale = [n for n in listed if belongs(_top(n)) and n not in fresh and n not in self.fixed]
        for name in stale + self._of_another_origin(listed, belongs):
            if _is_own(self.folder, self.folder / name, listed):
                _remove(self.folder, name)
            del listed[name]
        try:
            for name, stamp in fresh.items():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(staged / name, self.folder / name)
                listed[name] = Written(*stamp, STAGE if name in self.fixed else self.origin)
        except OSError as error:
            raise explained(error, self.folder / name) from error
        finally:
            write_list(self.folder, listed)


def read_list(folder: Path) -> dict[str, Written]:
    """Read which files the program has written into a folder, by relative path; none where there is no list, or a
    damaged one."""
    try:
        files = read_json_object(folder / LIST)["files"]
        return {
            n: Written(int(size), str(sha), str(origin)) for n, (size, sha, origin) in files.items() if _is_below(n)
        }
    except (InputError, KeyError, TypeError, ValueError, AttributeError):
        return {}


def write_list(folder: Path, files: Mapping[str, Written]) -> None:
    """Write the list of the files that the program has written into a folder."""
    about = "Files that msgs-slam has written into this folder: bytes, SHA-256 and origin. It replaces only these."
    write_json(folder / LIST, {"about": about, "files": dict(sorted(files.items()))})


def keep_others(old: Path, new: Path, written: Mapping[str, tuple[int, str]]) -> list[str]:
    """Move what does not come from the stage out of its earlier folder `old` into `new`, which takes the place of that
    and holds the files `written`, and list the files in `new`.

    Returns the names of what the program has written there on request: it still shows the earlier map.
    """
    listed, tops = read_list(old), {_top(name) for name in written}
    for path in [file for entry in _entries(old) for file in _files(entry)]:
        name = path.relative_to(old).as_posix()
        of_stage = name in written or (
            _is_own(old, path, listed) and listed[name].origin == STAGE if listed else _top(name) in tops
        )  # without a list it was written by an earlier version
        if not of_stage and not name.startswith(_STAGED) and name != LIST:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, new / name)
    kept = {n: w for n, w in listed.items() if w.origin != STAGE and n not in written and (new / n).is_file()}
    write_list(new, kept | {name: Written(*stamp, STAGE) for name, stamp in written.items()})
    return sorted({_top(name) for name in kept})


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


def _is_below(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and path.as_posix() == name


def _stamp(path: Path) -> tuple[int, str]:
    return path.stat().st_size, file_sha256(path)


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
        if entry.name.startswith(start) and entry.is_dir() and process.isdecimal() and not _is_alive(int(process)):
            shutil.rmtree(entry, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _joined(names: list[str]) -> str:
    tops = sorted({_top(name) for name in names})
    more = f" and {len(tops) - _NAMED} more" if len(tops) > _NAMED else ""
    return ", ".join(tops[:_NAMED]) + more
