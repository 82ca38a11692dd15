"""A run's files: data read back must be what the program writes there, or it is refused.

A layout says what an .npz file holds: name → kind and axes, as in "f N 3": kinds are f (finite floats), i (integers),
b (booleans), u (text); a letter is a length that is the same wherever it occurs; a name that ends in "?" may be
missing.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.images import read_grey_png, write_grey_png
from ...formats.reading import is_plain_name, parsing
from ...formats.tensors import load_arrays, load_tensors, save_arrays, save_tensors
from ...formats.textfile import MAX_OWN_JSON_BYTES, read_json, write_json

T = TypeVar("T")
_KINDS = {"f": "f", "i": "iu", "b": "b", "u": "U"}
_RIGID = 1e-4


def reading(path: Path, what: str) -> Any:
    """Around code that takes apart what a run's file holds: whatever it raises becomes an InputError."""
    advice = f"delete {path.name} and run `msgs-slam resume` for this run: the stage that wrote it makes it again"
    return parsing(path, what, advice)


@dataclass(frozen=True)
class RunFile(Generic[T]):
    """One kind of a run's files: its `name` in the folders of the `stages` that leave it, where {} stands for the frame
    it is of, and `what` it is called in errors.

    `pack` makes of a value what the file holds, `unpack` the value of that again, raising what it likes: by the name's
    suffix plain values (.json), arrays of a `layout` (.npz), tensors (.safetensors), or an image (.png).
    """

    name: str
    stages: tuple[str, ...]
    what: str
    unpack: Callable[[Any], T]
    pack: Callable[[T], Any] = field(default=lambda value: value)
    layout: Mapping[str, str] = field(default_factory=dict)

    def path(self, folder: Path, of: int | str = "") -> Path:
        """Return the file's path in a stage's folder. Raises InputError for a frame without a plain name."""
        if isinstance(of, str) and of and not is_plain_name(of):
            raise InputError(f"{folder} names the frame {of[:300]!r}, which no file can be called: use a whole copy")
        return folder / self.name.format(of)

    def save(self, folder: Path, value: T, of: int | str = "") -> Path:
        """Write the file into the folder of the running stage, whole or not at all; returns its path."""
        path = self.path(folder, of)
        _FORMATS[path.suffix][1](path, self.pack(value))
        return path

    def read(self, path: Path) -> T:
        """Inverse of `save`. Raises InputError for a file that is missing, or not what the program writes there."""
        held = _FORMATS[path.suffix][0](path)
        with reading(path, self.what):
            if self.layout:
                _require_layout(held, self.layout)
            return self.unpack(held)

    def find(self, folder: Path, of: int | str = "") -> T | None:
        """Read the file in a folder; None where there is none."""
        path = self.path(folder, of)
        return self.read(path) if path.exists() else None


_FORMATS: dict[str, tuple[Callable[[Path], Any], Callable[[Path, Any], None]]] = {
    ".json": (partial(read_json, limit=MAX_OWN_JSON_BYTES), write_json),
    ".npz": (partial(load_arrays, own=True), save_arrays),
    ".png": (read_grey_png, write_grey_png),
    ".safetensors": (load_tensors, save_tensors),
}


def _require_layout(arrays: Mapping[str, NDArray], layout: Mapping[str, str]) -> None:
    known = {name.rstrip("?") for name in layout}
    if more := sorted(set(arrays) - known):
        raise InputError(f"it holds {', '.join(more)}, which is not expected")
    lengths: dict[str, int] = {}
    for name, text in layout.items():
        if name.rstrip("?") not in arrays:
            if not name.endswith("?"):
                raise ValueError(f"{name} is missing")
            continue
        _require_array(name.rstrip("?"), arrays[name.rstrip("?")], text.split(), lengths)


def _require_array(name: str, array: NDArray, layout: list[str], lengths: dict[str, int]) -> None:
    kind, axes = layout[0], layout[1:]
    if array.dtype.kind not in _KINDS[kind]:
        raise ValueError(f"{name} is of type {array.dtype}")
    wanted = [int(a) if a.isdigit() else lengths.get(a) for a in axes]
    if array.ndim != len(axes) or any(w not in (None, s) for w, s in zip(wanted, array.shape, strict=True)):
        raise ValueError(f"{name} has shape {array.shape}, expected {' x '.join(axes)}")
    lengths.update({a: s for a, s in zip(axes, array.shape, strict=True) if not a.isdigit()})
    if kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")


def require_indices(name: str, indices: NDArray, length: int) -> None:
    """Raise ValueError unless every index is in 0..length-1."""
    if indices.size and not (indices.min() >= 0 and indices.max() < length):
        raise ValueError(f"{name} points outside 0..{length - 1}")


def require_increasing(name: str, ids: NDArray) -> None:
    """Raise ValueError unless the ids are distinct, in order and not negative."""
    if ids.size and not (ids[0] >= 0 and (np.diff(ids) > 0).all()):
        raise ValueError(f"{name} are not in order")


def require_rigid(name: str, motions: NDArray) -> None:
    """Raise ValueError unless each (..., 4, 4) is a rotation and a translation."""
    rotation = motions[..., :3, :3]
    square = rotation @ np.swapaxes(rotation, -1, -2)
    if not (
        np.abs(square - np.eye(3)).max(initial=0) < _RIGID
        and (np.linalg.det(rotation) > 0).all()
        and (motions[..., 3, :] == [0, 0, 0, 1]).all()
    ):
        raise ValueError(f"{name} are no rotations and translations")
