"""Intermediate arrays of the stage on disk: whole or not there, uncompressed, gone when the stage ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.atomic import atomic_path
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.tensors import load_arrays


def save_scratch(path: Path, **arrays: NDArray) -> None:
    """Write an npz atomically, without the time that compression takes."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_scratch(path: Path) -> dict[str, NDArray]:
    """Inverse of `save_scratch`. Raises InputError when the file is damaged."""
    try:
        return load_arrays(path, own=True)
    except InputError as error:
        raise InputError(f"{error}; delete it and run `msgs-slam resume`") from error
