"""Values as files, for going on after an interruption: dataclasses of this program, arrays and plain values."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...formats.reading import parsing
from ...formats.tensors import load_arrays, save_arrays

_TREE = "tree"
_OURS = "msgs_slam.pipelines."


def save_value(path: Path, value: Any) -> None:
    """One .npz, whole or not at all. Raises TypeError for what is neither of these."""
    columns = _Columns()
    tree = json.dumps(_plain(value, columns))
    arrays = {name: np.concatenate(parts) for name, parts in columns.parts.items()}
    save_arrays(path, {**arrays, _TREE: np.frombuffer(tree.encode(), np.uint8)}, compress=False)


def load_value(path: Path) -> Any:
    """Inverse of `save_value`. Raises InputError for a file that is missing or damaged, or names a class of others."""
    arrays = load_arrays(path, own=True)
    with parsing(path, "value of this program", "delete it"):
        return _value(json.loads(arrays[_TREE].tobytes()), arrays)


def _name_of(kind: type) -> str:
    if not kind.__module__.startswith(_OURS):
        raise TypeError(f"{kind} is not kept in files")
    return f"{kind.__module__.removeprefix(_OURS)}:{kind.__qualname__}"


def _of_name(name: str) -> type:
    """Find a dataclass that this program's pipelines define. Raises TypeError for anything else."""
    module, _, attribute = name.partition(":")
    found = getattr(import_module(_OURS + module), attribute) if module.replace(".", "_").isidentifier() else None
    if not (isinstance(found, type) and is_dataclass(found) and found.__module__ == _OURS + module):
        raise TypeError(f"{name} is no dataclass of this program")
    return found


@dataclass
class _Columns:
    """All arrays of one type after each other: there may be thousands of small ones."""

    parts: dict[str, list[NDArray]] = field(default_factory=dict)
    length: dict[str, int] = field(default_factory=dict)

    def add(self, array: NDArray) -> list[Any]:
        """Append the array; returns by what `_array` finds it again."""
        kind, order = array.dtype.str, _order(array)
        start = self.length.get(kind, 0)
        self.parts.setdefault(kind, []).append(array.ravel(order))
        self.length[kind] = start + array.size
        return [kind, start, array.shape, order]


def _order(array: NDArray) -> Literal["C", "F"]:
    return "F" if np.isfortran(array) else "C"


def _array(
    columns: Mapping[str, NDArray], kind: str, start: int, shape: list[int], order: Literal["C", "F"]
) -> NDArray:
    return columns[kind][start : start + math.prod(shape)].reshape(shape, order=order)


def _plain(value: Any, arrays: _Columns) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return {"array": arrays.add(value)}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_plain(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_plain(k, arrays), _plain(v, arrays)] for k, v in value.items()]}
    if is_dataclass(value) and not isinstance(value, type):
        of = {f.name: _plain(getattr(value, f.name), arrays) for f in fields(value) if f.init}
        return {_name_of(type(value)): of}
    raise TypeError(f"{type(value)} is not kept in files")


def _value(tree: Any, arrays: Mapping[str, NDArray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "path":
        return Path(content)
    if kind == "array":
        return _array(arrays, *content)
    if kind in ("tuple", "list"):
        items = [_value(v, arrays) for v in content]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {_value(k, arrays): _value(v, arrays) for k, v in content}
    return _of_name(kind)(**{name: _value(v, arrays) for name, v in content.items()})
