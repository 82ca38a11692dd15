"""Layouts of a run's files: data read back must be what the program writes there, or it is refused.

A layout says what an .npz file holds: name → kind and axes, as in "f N 3": kinds are f (finite floats), i (integers),
b (booleans), u (text); a letter is a length that is the same wherever it occurs; a name that ends in "?" may be
missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import parsing
from msgs_slam.formats.tensors import load_arrays

T = TypeVar("T")
_KINDS = {"f": "f", "i": "iu", "b": "b", "u": "U"}
_RIGID = 1e-4

TRAJECTORY = {
    "frame_ids": "i N", "timestamps": "f N", "cam_from_world": "f N 4 4", "is_keyframe": "b N", "lost_reasons": "u N",
    "by_rotation?": "b N",
}  # fmt: skip
SPARSE_MODEL = {
    "frame_ids": "i N", "cam_from_world": "f N 4 4", "points_in_world": "f P 3", "colors": "i P 3",
    "obs_frame": "i O", "obs_point": "i O", "obs_xy": "f O 2",
}  # fmt: skip
FEATURES = {"keypoints": "f F 4", "descriptors": "i F 128"}
VOCABULARY = {"words": "f W 128", "mean": "f D"}
TRIED = {"rows": "i P 3"}
PROXY_MAPS = {"inverse_depth": "f H W", "confidence": "i H W", "labels": "i H W", "label_confidence": "i H W"}
EXPOSURE = {"frame_ids": "i N", "log_gains": "f N 3", "offsets": "f N 3"}
DESCRIPTORS = {"frame_ids": "i N", "vectors": "f N F"}
DEPTH_FIELDS = {"frame_ids": "i N", "log_scales": "f N R C"}
BEFORE = {"source_index": "i N", "cam_from_world": "f N 4 4", "is_placed": "b N", "was_chosen": "b N"}


def what_to_do(path: Path) -> str:
    """Advice for a file of a run that cannot be used."""
    return f"delete {path.name} and run `msgs-slam resume` for this run: the stage that wrote it makes it again"


def reading(path: Path, what: str) -> Any:
    """Around code that takes apart what a run's file holds: whatever it raises becomes an InputError."""
    return parsing(path, what, what_to_do(path))


def load_layout(path: Path, layout: Mapping[str, str]) -> dict[str, NDArray]:
    """The arrays of an .npz file, every one of the layout and no other. Raises InputError for anything else."""
    arrays = load_arrays(path, own=True)
    with reading(path, "file of this program"):
        _require_layout(arrays, layout)
    return arrays


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


def dataclass_from_json(cls: type[T], value: Any) -> T:
    """A dataclass of plain fields from its `asdict` after JSON; what has a default may be missing. Raises ValueError
    for other keys or types."""
    types = get_type_hints(cls)
    defaults = {f.name: f.default for f in fields(cls)}  # type: ignore[arg-type]
    names = list(defaults)
    needed = {name for name, default in defaults.items() if default is MISSING}
    if not isinstance(value, dict) or not needed <= set(value) <= set(names):
        found = sorted(map(str, value)) if isinstance(value, dict) else type(value).__name__
        raise ValueError(f"{cls.__name__}: expected {', '.join(names)}, got {found}")
    return cls(**{name: _field(types[name], value[name], f"{cls.__name__}.{name}") for name in value})


def _field(wanted: Any, value: Any, name: str) -> Any:
    if isinstance(wanted, type) and is_dataclass(wanted):
        return dataclass_from_json(wanted, value)
    if wanted in (int, float, str, bool):
        fits = isinstance(value, int | float) if wanted is float else isinstance(value, wanted)
        if not fits or (isinstance(value, bool) and wanted is not bool):
            raise ValueError(f"{name} is {str(value)[:40]!r}, expected {wanted.__name__}")
        return wanted(value)
    array = np.asarray(value, np.float64)  # what is left are tuples and matrices of numbers
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return array if wanted is np.ndarray or "NDArray" in str(wanted) or "ndarray" in str(wanted) else tuple(array)
