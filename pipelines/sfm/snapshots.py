"""Snapshots of the features, matches and models found so far, from which a killed run resumes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pycolmap

from ...formats.atomic import free_bytes, write_bytes
from ...formats.errors import DiskFullError
from ...formats.textfile import read_json, write_json
from ..system.values import load_value, save_value

T = TypeVar("T")
_DATABASE_SHARE = 3
"""Bytes of the database and the models made from it, over those of the features and matches: a guess on the safe
side."""
_MIN_ROOM = 30_000_000


def features_name(frame_id: int) -> str:
    """Under which a frame's features are stored."""
    return f"features/{frame_id:06d}"


def pairs_name(block: int) -> str:
    """Under which a block of verified pairs is stored."""
    return f"pairs/{block:06d}"


@dataclass(frozen=True)
class Snapshots:
    """Files under one folder; each is whole or missing."""

    folder: Path

    def inside(self, name: str) -> Snapshots:
        """Return the snapshots of a folder inside this one, which is made."""
        (folder := self.folder / name).mkdir(exist_ok=True)
        return Snapshots(folder)

    def value(self, name: str, compute: Callable[[], T]) -> T:
        """Return a value, computed unless it is stored."""
        path = self.folder / f"{name}.npz"
        if path.exists():
            stored: T = load_value(path)
            return stored
        value = compute()
        save_value(path, value)
        return value

    def model(
        self, name: str, compute: Callable[[Path], pycolmap.Reconstruction | None]
    ) -> pycolmap.Reconstruction | None:
        """Return a reconstruction, computed in a scratch folder unless it is stored; None where there is none.

        It is always read back from disk: the order in memory of a fresh model and of one read differ, and with it the
        order in which an adjustment adds.
        """
        path, scratch = self.folder / name, self.folder / f"{name}.tmp"
        listed = path / "files.json"
        if not listed.exists() or not all((path / n).exists() for n in read_json(listed)):
            shutil.rmtree(scratch, ignore_errors=True)
            (scratch / "work").mkdir(parents=True)
            (scratch / "model").mkdir()
            self._require_room()
            model = compute(scratch / "work")
            if model is not None:
                model.write_binary(scratch / "model")
            files = sorted((scratch / "model").iterdir())
            for file in files:
                write_bytes(path / file.name, file.read_bytes())
            write_json(listed, [file.name for file in files])
            shutil.rmtree(scratch)
            del model  # not beside the one that is read
        return pycolmap.Reconstruction(path) if (path / "cameras.bin").exists() else None

    def _require_room(self) -> None:
        """COLMAP ends the whole process where its database cannot grow, so there must be room for it before.

        It is taken for a moment: the free space says nothing about a quota or the largest file allowed.
        """
        needed = _DATABASE_SHARE * sum(p.stat().st_size for p in self.folder.glob("*/*.npz")) + _MIN_ROOM
        place = self.folder / "room.tmp"
        try:
            with place.open("wb") as file:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, needed)
                elif free_bytes(self.folder) < needed:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise DiskFullError(
                f"{self.folder}: structure from motion needs {needed / 1e6:.0f} MB of disk, which cannot be had "
                f"({error.strerror}). Free some space, then run the same command again"
            ) from error
        finally:
            place.unlink(missing_ok=True)
