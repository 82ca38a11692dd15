"""A network over many frames: nothing is computed twice, and a long pass says beforehand how long."""

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import atomic_path
from ...formats.errors import InputError
from ...formats.reading import noting_files
from ...formats.tensors import load_arrays
from ..geometry.sequence import Sequence
from ..system.progress import Progress, log
from ..system.values import load_value, save_value
from ..types import Frame

Arrays = dict[str, NDArray]
_STAMP = "stamp"
_MEASURED = 3
_LONG = 120.0


def _stamp(key: str, arrays: Arrays) -> str:
    """What a result is of and what it holds, kept with it: another one in its place, or another content, is seen."""
    digest = hashlib.sha256(key.encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"\0{name} {array.dtype.str} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class ResultCache:
    """Results of networks by content, over runs: at most `megabytes` of them, those used last stay. 0 keeps none."""

    folder: Path
    megabytes: int

    def load(self, key: str) -> Arrays | None:
        """None where there is none; a damaged one, or one of another key, is made again."""
        path = self._path(key)
        try:
            if self.megabytes <= 0 or not path.exists():
                return None
            with noting_files():  # what made it is in its name
                found = load_arrays(path)
            if found.pop(_STAMP, np.array("")).tolist() != _stamp(key, found):
                return None
            os.utime(path)
        except (InputError, OSError) as error:
            log.info("%s: the result is not used (%s)", path, error)
            return None
        return found

    def save(self, key: str, arrays: Arrays) -> None:
        """Keep a result. A cache that cannot be written is no reason to stop."""
        if self.megabytes <= 0:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_path(self._path(key)) as temporary, temporary.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **arrays, **{_STAMP: np.array(_stamp(key, arrays))})
        except (InputError, OSError) as error:
            log.info("%s: the result is not kept (%s)", self.folder, error)

    def trim(self) -> None:
        """Remove what was used longest ago until the rest fits. Without a cache, that of other runs is left alone."""
        if self.megabytes <= 0:
            return
        try:
            self._trim()
        except OSError as error:
            log.info("%s: nothing is removed (%s)", self.folder, error)

    def _trim(self) -> None:
        entries = sorted((p.stat().st_mtime_ns, p.stat().st_size, p) for p in self.folder.glob("*.npz"))
        total = sum(size for _, size, _ in entries)
        for _, size, path in entries:
            if total <= self.megabytes * 1_000_000:
                break
            path.unlink(missing_ok=True)
            total -= size

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


@dataclass(frozen=True)
class Workplace:
    """Frames and resources of a network pass; `folder()` keeps this run's results, `cache` those of all runs."""

    sequence: Sequence
    folder: Callable[[], Path]
    threads: int
    device: str
    progress: Progress
    cache: ResultCache


class NetworkPass:
    """`compute` turns an image (h, w, 3) into named arrays; `identity` says what else they depend on."""

    def __init__(
        self, name: str, identity: str, place: Workplace, compute: Callable[[NDArray[np.uint8]], Arrays]
    ) -> None:
        self._name, self._identity, self._place, self._compute = name, identity, place, compute

    def run(self, frames: list[Frame]) -> None:
        """Results of all frames to the disk; what is there stays, what another run has computed is taken over."""
        cache = self._place.cache
        todo = [f for f in frames if not self._is_whole(f)]
        computed, seconds = 0, 0.0
        for done, frame in enumerate(self._place.progress.track(todo, "network", len(todo))):
            image = self._place.sequence.image(frame)
            key = self._key(image)
            arrays = cache.load(key)
            if arrays is None:
                started = time.monotonic()
                arrays = self._compute(image)
                seconds += time.monotonic() - started
                computed += 1
                cache.save(key, arrays)
                if computed == _MEASURED:
                    self._announce(seconds / computed, len(todo) - done - 1)
            save_value(self._path(frame), arrays)
        cache.trim()

    def load(self, frame: Frame) -> Arrays:
        """Load the results of `run` for a frame."""
        arrays: Arrays = load_value(self._path(frame))
        return arrays

    def _is_whole(self, frame: Frame) -> bool:
        """A damaged result is made again like a missing one."""
        try:
            return self._path(frame).exists() and bool(self.load(frame))
        except InputError:
            return False

    def _announce(self, seconds: float, left: int) -> None:
        """Said once, after the first frames, when it will be long."""
        if seconds * left > _LONG:
            log.warning(
                "%s: about %.0f minutes for %d more frames (%.1f s each); if interrupted, `msgs-slam resume` "
                "continues. Networks of other sizes are in `msgs-slam models list`: --depth NAME, --semantics NAME",
                self._name, seconds * left / 60, left, seconds,
            )  # fmt: skip

    def _key(self, image: NDArray[np.uint8]) -> str:
        return hashlib.sha256(f"{self._identity} {image.shape} ".encode() + image.tobytes()).hexdigest()

    def _path(self, frame: Frame) -> Path:
        return self._place.folder() / f"{frame.id:06d}.npz"
