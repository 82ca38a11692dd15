"""Snapshots of the features, matches and models found so far, from which a killed run resumes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from msgs_slam.formats.atomic import free_bytes, write_bytes
from msgs_slam.formats.errors import DiskFullError
from msgs_slam.formats.jsonfile import read_json, write_json
from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.correspondence.matching import VerifiedPair
from msgs_slam.pipelines.types import Features

_DATABASE_SHARE = 3
"""Bytes of the database and the models made from it, over those of the packed features and matches: a guess on the safe
side, descriptors hardly pack."""
_LEAST_ROOM = 30_000_000


@dataclass(frozen=True)
class Snapshots:
    """Files under one folder; each is whole or missing."""

    folder: Path

    def features(self, frame_id: int, compute: Callable[[], Features]) -> Features:
        """Features of a frame, computed unless they are stored."""
        path = self.folder / "features" / f"{frame_id:06d}.npz"
        if not path.exists():
            features = compute()
            save_arrays(path, {"keypoints": features.keypoints, "descriptors": features.descriptors})
            return features
        return Features(**load_arrays(path, own=True))

    def pairs(self, block: int, compute: Callable[[], list[VerifiedPair]]) -> list[VerifiedPair]:
        """One block of verified pairs, computed unless they are stored."""
        path = self.folder / "pairs" / f"{block:06d}.npz"
        if not path.exists():
            pairs = compute()
            save_arrays(path, _pack(pairs))
            return pairs
        return _unpack(load_arrays(path, own=True))

    def model(
        self, name: str, compute: Callable[[Path], pycolmap.Reconstruction | None]
    ) -> pycolmap.Reconstruction | None:
        """A reconstruction, computed in a scratch folder unless it is stored; None where there is none.

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
        needed = _DATABASE_SHARE * sum(p.stat().st_size for p in self.folder.glob("*/*.npz")) + _LEAST_ROOM
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


def _pack(pairs: Sequence[VerifiedPair]) -> dict[str, NDArray]:
    return {
        "index": np.array([(p.first, p.second, p.config, p.proposed, len(p.matches)) for p in pairs]).reshape(-1, 5),
        "matches": _concatenated([p.matches for p in pairs]),
        "matrices": np.array([p.matrices for p in pairs]).reshape(-1, 3, 3, 3),
    }


def _unpack(arrays: dict[str, NDArray]) -> list[VerifiedPair]:
    index = arrays["index"].astype(np.int64)
    ends = np.cumsum(index[:, 4])
    return [
        VerifiedPair(int(i), int(j), arrays["matches"][end - count : end], int(config), matrices, int(proposed))
        for (i, j, config, proposed, count), end, matrices in zip(index, ends, arrays["matrices"], strict=True)
    ]


def _concatenated(parts: Iterable[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    return np.concatenate([np.zeros((0, 2), np.uint32), *parts])
