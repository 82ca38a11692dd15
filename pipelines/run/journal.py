"""Journal of an unfinished stage's files, from which a resumed attempt knows which of them are complete."""

from __future__ import annotations

import glob
import shutil
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ...formats.atomic import process_mark
from ...formats.digest import file_sha256
from ...formats.errors import RecoverableError
from ..system.stopping import stop_if_asked
from ..system.wording import quoted

JOURNAL = ".written"


@dataclass(frozen=True)
class Journal:
    """A line `sha256 path` for every file that is written atomically below `folder`, before it takes its name.

    Each process has a file of its own for its lines: where several machines append to one over a network disk, one's
    line may be written over another's.

    Handed to `formats.atomic.watched_by`, so that no stage has to think of it. A file may have several lines: one that
    was killed between the line and the renaming still has the content of an earlier line, which is a whole one too.
    """

    folder: Path
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def writing(self, path: Path, temporary: Path) -> None:
        """Note the file that is about to be renamed to `path`."""
        if path.is_relative_to(self.folder):
            # The end of line comes first: a line that a full disk has cut must not swallow the one after it.
            line = f"\n{file_sha256(temporary)} {path.relative_to(self.folder).as_posix()}"
            with self._lock, (self.folder / f"{JOURNAL}-{process_mark()}").open("a", encoding="utf-8") as stream:
                stream.write(line)

    def written(self, path: Path) -> None:
        """The moment at which nothing is lost: here the work stops where the user has asked for it."""
        if path.is_relative_to(self.folder):
            stop_if_asked()

    def files(self) -> list[Path]:
        """The journals of all processes that have written here; one without a mark is of an earlier version."""
        return sorted(self.folder.glob(f"{JOURNAL}*"))

    def discard_damaged(self, keep: tuple[str, ...] = ()) -> list[str]:
        """Remove every file that is not as some line says, and folders left empty; returns the names of those that
        have a line. What has none was being written when the attempt ended, or is no file of the stage."""
        known = self._known()
        keep = (*keep, *(path.name for path in self.files()))
        damaged = []
        for path in sorted(p for p in self.folder.rglob("*") if p.is_file() or p.is_symlink()):
            name = path.relative_to(self.folder).as_posix()
            if name in keep or (not path.is_symlink() and _digest(path) in known.get(name, ())):
                continue
            damaged += [name] if name in known else []
            path.unlink()
        for folder in sorted((p for p in self.folder.rglob("*") if p.is_dir()), reverse=True):
            if not any(folder.iterdir()):
                folder.rmdir()
        return damaged

    def check(self, files: dict[str, tuple[int, str]]) -> None:
        """Compare the files that a stage has left with what was written.

        Raises RecoverableError where one is not what was written: a full or failing disk may keep less than it said.
        """
        known = self._known()
        torn = [name for name, (_, digest) in files.items() if digest not in known.get(name, ())]
        if torn:
            raise RecoverableError(
                f"{self.folder / torn[0]} is not what was written there ({len(torn)} such files): the disk may be full "
                f"or failing. Run `msgs-slam resume {quoted(self.folder.parent)}`"
            )

    def _known(self) -> dict[str, set[str]]:
        known: dict[str, set[str]] = {}
        for path in self.files():
            for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
                digest, _, name = line.partition(" ")
                known.setdefault(name, set()).add(digest)
        return known


def _digest(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError:
        return ""


def discard(folder: Path) -> None:
    """Remove a folder whose name is needed. It is renamed first: what other processes have open in it may stay on a
    network disk for as long as they do, in a folder beside it that the next call removes."""
    with suppress(FileNotFoundError):
        folder.rename(folder.with_name(f".{folder.name}.old-{time.time_ns()}"))
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.old-*"):
        shutil.rmtree(old, ignore_errors=True)


def empty(folder: Path) -> None:
    """Make the folder, with nothing in it."""
    discard(folder)
    folder.mkdir(parents=True)
