"""Named arrays on disk: npz for numpy, safetensors for torch. Never pickle."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray

from formats.atomic import atomic_path
from formats.errors import InputError

MAX_BYTES = 8 << 30
"""A file that unpacks to more than this is refused: a few kilobytes of zip can claim to hold petabytes."""


def save_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write a compressed npz atomically. Equal arrays give equal bytes (numpy stamps members with a fixed date).

    Raises ValueError for an array of objects, DiskFullError when there is no room.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"{name}: an array of objects cannot be stored without pickle")
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **dict(arrays))


def load_arrays(path: Path) -> dict[str, NDArray]:
    """All arrays of an npz. Raises InputError when it is missing, damaged, pickled or too large."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_BYTES:
            raise InputError(
                f"{path}: unpacks to {size / 1e9:.1f} GB, more than {MAX_BYTES / 1e9:.0f} GB; it is not ours"
            )
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{path}: cannot be read as npz ({error}). Delete it and run the stage again") from error


def save_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a safetensors file atomically; tensors are copied to the CPU."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
        safetensors.torch.save_file(contiguous, temporary)


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """All tensors of a safetensors file, on the CPU. Raises InputError when it is missing or damaged."""
    try:
        return safetensors.torch.load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise InputError(
            f"{path}: cannot be read as safetensors ({error}). Delete it and run the stage again"
        ) from error
