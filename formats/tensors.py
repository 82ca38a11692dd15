"""Named arrays on disk: npz for numpy, safetensors for torch and for arrays with metadata. Never pickle."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from formats.atomic import atomic_path
from formats.errors import InputError

if TYPE_CHECKING:
    import torch

MAX_ARRAY_BYTES = 16 * 1024**3
"""A file whose arrays would take more memory in total is refused."""

_MAX_HEADER_BYTES = 100_000_000


def save_arrays(path: Path, arrays: Mapping[str, NDArray], *, compress: bool = True) -> None:
    """Write named arrays to an .npz file, atomically; the same arrays give the same bytes.

    Raises ValueError for an array of objects (numpy would pickle it), InputError when the disk refuses.
    """
    for name, array in arrays.items():
        if np.asanyarray(array).dtype.hasobject:
            raise ValueError(f"{name}: an array of objects cannot be stored without pickle")
    with atomic_path(Path(path)) as temporary:
        kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        with zipfile.ZipFile(temporary, "w", kind, allowZip64=True) as archive:
            for name in sorted(arrays):
                # ZipInfo's own date is fixed, unlike the clock that np.savez writes.
                entry = zipfile.ZipInfo(f"{name}.npy")
                entry.compress_type = kind
                with archive.open(entry, "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asanyarray(arrays[name]), allow_pickle=False)


def load_arrays(path: Path) -> dict[str, NDArray]:
    """The arrays of an .npz file.

    Raises InputError when it is missing, damaged, holds objects, or unpacks to more than `MAX_ARRAY_BYTES`.
    """
    path = Path(path)
    _require_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > MAX_ARRAY_BYTES:
            raise InputError(f"{path} would unpack to {total / 1e9:.0f} GB: it is not a file of this program")
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, KeyError, MemoryError) as error:
        raise InputError(f"{path} is damaged or no .npz file of plain arrays ({error}): make it again") from error


def save_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a .safetensors file atomically; tensors are copied to the CPU. Raises InputError when the disk refuses."""
    import safetensors.torch  # torch is slow to import, and most of this package does without

    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(Path(path)) as temporary:
        safetensors.torch.save_file(contiguous, temporary)


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """All tensors of a .safetensors file, on the CPU. Raises InputError as `load_safetensors` does."""
    import safetensors.torch

    _require_file(Path(path))
    try:
        return safetensors.torch.load_file(path)
    except (SafetensorError, ValueError, OSError) as error:
        raise InputError(f"{path} is damaged or no .safetensors file ({error}): make it again") from error


def save_safetensors(path: Path, arrays: Mapping[str, NDArray], meta: Mapping[str, str] | None = None) -> None:
    """Write named arrays to a .safetensors file, atomically; the same arrays give the same bytes.

    Raises InputError when the disk refuses.
    """
    contiguous = {name: np.ascontiguousarray(arrays[name]) for name in sorted(arrays)}
    with atomic_path(Path(path)) as temporary:
        save_file(contiguous, str(temporary), metadata=dict(meta or {}))
        _sort_metadata(temporary)


def load_safetensors(path: Path) -> tuple[dict[str, NDArray], dict[str, str]]:
    """The arrays and the metadata of a .safetensors file.

    Raises InputError when it is missing, damaged, cut short or too large.
    """
    path = Path(path)
    _require_file(path)
    if path.stat().st_size > MAX_ARRAY_BYTES:
        raise InputError(f"{path} is larger than {MAX_ARRAY_BYTES / 1e9:.0f} GB: it is not a file of this program")
    try:
        with safe_open(str(path), framework="numpy") as file:
            return {name: file.get_tensor(name) for name in sorted(file.keys())}, dict(file.metadata() or {})
    except (SafetensorError, TypeError, ValueError, OSError) as error:
        raise InputError(f"{path} is damaged or no .safetensors file ({error}): make it again") from error


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"no such file: {path}: check the spelling, or run the step that makes it")


def _sort_metadata(path: Path) -> None:
    """safetensors writes its metadata in hash order, another in every process: put the header's keys in order."""
    with path.open("r+b") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        if size > _MAX_HEADER_BYTES:
            raise ValueError(f"safetensors header of {size} bytes")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header.get("__metadata__", {}).items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) > size:
            return  # cannot happen with the library's own compact JSON; the file is good as it is
        file.seek(8)
        file.write(text.ljust(size))
