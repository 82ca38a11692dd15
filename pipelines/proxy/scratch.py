"""Intermediate arrays of the stage on disk: whole or not there, uncompressed, gone when the stage ends."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import atomic_path
from formats.errors import InputError


def save_scratch(path: Path, **arrays: NDArray) -> None:
    """Write an npz atomically, without the time that compression takes."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_scratch(path: Path) -> dict[str, NDArray]:
    """Inverse of `save_scratch`. Raises InputError when the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{path}: cannot be read ({error}). Delete it and type `msgs-slam resume`") from error
