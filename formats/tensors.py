"""Named arrays on disk: npz for numpy, safetensors for torch. Never pickle."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import InputError
from .reading import parsing, require_file

if TYPE_CHECKING:
    import torch

_DTYPES = {
    "float64": "F64", "float32": "F32", "float16": "F16", "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8",
    "uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL",
}  # fmt: skip

_READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
HEADERS = Lock()
"""Held while numpy reads the header of an array: it parses it as Python, and CPython 3.11 raises SystemError where
two threads of different depth parse at once (python/cpython#106905)."""
MAX_UNPACKED_BYTES = 1024**3
"""A packed file whose arrays would take more memory in total is refused: a few kilobytes can unpack to anything."""
MOST_PACKED = 50
"""Of a run's own file each byte may unpack to so many on top: deflate could make a thousand of it, arrays of this
program pack to a tenth at best where they are large."""


def save_arrays(path: Path, arrays: Mapping[str, NDArray], *, compress: bool = True) -> None:
    """Write named arrays to an .npz file, atomically; the same arrays give the same bytes.

    Raises ValueError for an array of objects (numpy would pickle it), InputError when the disk refuses.
    """
    for name, array in arrays.items():
        if np.asanyarray(array).dtype.hasobject:
            raise ValueError(f"{name}: an array of objects cannot be stored without pickle")
    with atomic_path(Path(path)) as temporary:
        kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        # Level 4 takes two fifths of the time of level 6 for files that are a twentieth larger.
        with zipfile.ZipFile(temporary, "w", kind, compresslevel=4) as archive:
            for name in sorted(arrays):
                # Opened by name its date is fixed, unlike the clock that np.savez writes.
                with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asanyarray(arrays[name]), allow_pickle=False)


def load_arrays(path: Path, *, own: bool = False) -> dict[str, NDArray]:
    """Return the arrays of an .npz file; `own`: one of a run.

    Raises InputError when it is missing, damaged, holds objects, or unpacks to more than `MAX_UNPACKED_BYTES`; one of a
    run may be larger where the file is (`MOST_PACKED`): what was written of a long recording has to be read again. A
    run's checksums are no reason to trust it further, for whoever made the run made them too.
    """
    limit = MAX_UNPACKED_BYTES + own * MOST_PACKED * require_file(path)
    with parsing(path, ".npz file of plain arrays", "make it again"), zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        total = sum(entry.file_size for entry in entries)
        if total > limit:
            raise InputError(f"{path} would unpack to {total / 1e9:.0f} GB: it is not a file of this program")
        arrays = {}
        for entry in entries:
            with archive.open(entry) as stream:
                arrays[entry.filename.removesuffix(".npy")] = _read_array(stream, entry.file_size)
        return arrays


def _read_array(stream: IO[bytes], size: int) -> NDArray:
    """The array in .npy format that a stream of `size` bytes holds. Raises ValueError for anything else."""
    version = np.lib.format.read_magic(stream)
    if version not in _READ_HEADER:
        raise ValueError(f"version {version} of an array is not known")
    with HEADERS:
        shape, is_fortran, dtype = _READ_HEADER[version](stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != size - stream.tell():
        raise ValueError("a member of it is no plain array")
    flat = np.empty(math.prod(shape), dtype)
    bytes_of = flat.view(np.uint8).data
    if stream.readinto(bytes_of) != len(bytes_of) or stream.read(1):  # type: ignore[attr-defined]
        raise ValueError("a member of it ends too early")
    return flat.reshape(shape[::-1]).T if is_fortran else flat.reshape(shape)


def save_tensors(path: Path, tensors: Mapping[str, torch.Tensor | NDArray]) -> None:
    """Write a .safetensors file atomically; tensors are copied to the CPU; the same ones give the same bytes. Raises
    InputError when the disk refuses."""
    # The library holds all of it in memory twice before it writes, which would be the peak memory of the mapping stage.
    arrays = {
        n: np.asarray(t if isinstance(t, np.ndarray) else t.detach().cpu(), order="C") for n, t in tensors.items()
    }
    names = sorted(arrays, key=lambda name: (-arrays[name].itemsize, name))  # so that each is aligned
    header: dict[str, Any] = {}
    end = 0
    for name in names:
        array, begin = arrays[name], end
        end += array.nbytes
        header[name] = {"dtype": _DTYPES[array.dtype.name], "shape": list(array.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text = text.ljust(-(-len(text) // 8) * 8)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in names:
            file.write(arrays[name].reshape(-1).view(np.uint8).data)


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Return all tensors of a run's .safetensors file, on the CPU. Raises InputError when it is missing or damaged."""
    import safetensors.torch

    require_file(path)
    with parsing(path, ".safetensors file", "make it again"):
        return safetensors.torch.load_file(path)
