"""Named arrays on disk: npz for numpy, safetensors for torch. Never pickle."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.atomic import atomic_path
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import parsing, require_file

if TYPE_CHECKING:
    import torch

_DTYPES = {
    "float64": "F64", "float32": "F32", "float16": "F16", "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8",
    "uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL",
}  # fmt: skip

MAX_UNPACKED_BYTES = 1024**3
"""A foreign packed file whose arrays would take more memory in total is refused: a few kilobytes can unpack to
anything."""


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


def load_arrays(path: Path, *, own: bool = False) -> dict[str, NDArray]:
    """The arrays of an .npz file; `own`: one of a run, which a checksum says that this program has written.

    Raises InputError when it is missing, damaged, or holds objects; a foreign one too when it unpacks to more than
    `MAX_UNPACKED_BYTES`: what was written of a long recording has to be read again, however large.
    """
    require_file(path)
    with parsing(path, ".npz file of plain arrays", "make it again"):
        with zipfile.ZipFile(path) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > MAX_UNPACKED_BYTES and not own:
            raise InputError(f"{path} would unpack to {total / 1e9:.0f} GB: it is not a file of this program")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("a member of it is no array")
        return arrays


def save_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a .safetensors file atomically; tensors are copied to the CPU. Raises InputError when the disk refuses."""
    save_safetensors(path, {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items()})


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """All tensors of a run's .safetensors file, of any size, on the CPU. Raises InputError when it is missing
    or damaged."""
    import safetensors.torch

    require_file(path)
    with parsing(path, ".safetensors file", "make it again"):
        return safetensors.torch.load_file(path)


def save_safetensors(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write named arrays to a .safetensors file, atomically; the same arrays give the same bytes.

    Raises InputError when the disk refuses.
    """
    # The library holds all of it in memory twice before it writes, which were the peak of a mapping.
    contiguous = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    names = sorted(contiguous, key=lambda name: (-contiguous[name].itemsize, name))  # so that each is aligned
    header: dict[str, Any] = {}
    end = 0
    for name in names:
        array, begin = contiguous[name], end
        end += array.nbytes
        header[name] = {"dtype": _DTYPES[array.dtype.name], "shape": list(array.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text = text.ljust(-(-len(text) // 8) * 8)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in names:
            file.write(contiguous[name].reshape(-1).view(np.uint8).data)
