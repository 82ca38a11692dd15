"""Values as files, for going on after an interruption: dataclasses of this program, arrays and plain values; and
dataclasses from the plain values of JSON and TOML."""

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ...formats.reading import parsing
from ...formats.tensors import load_arrays, save_arrays

T = TypeVar("T")
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


def dataclass_from_json(cls: type[T], value: Any) -> T:
    """A dataclass of plain fields from its `asdict` after JSON; what has a default may be missing. Raises ValueError
    for other keys or types."""
    types, known = get_type_hints(cls), fields(cls)  # type: ignore[arg-type]
    names = [f.name for f in known]
    needed = {f.name for f in known if f.default is MISSING and f.default_factory is MISSING}
    if not isinstance(value, dict) or not needed <= set(value) <= set(names):
        found = sorted(map(str, value)) if isinstance(value, dict) else type(value).__name__
        raise ValueError(f"{cls.__name__}: expected {', '.join(names)}, got {found}")
    return cls(**{name: value_from_json(types[name], value[name], f"{cls.__name__}.{name}") for name in value})


def value_from_json(wanted: Any, value: Any, name: str) -> Any:
    """Check a plain value against an annotation, and make that type of it. Raises ValueError, which names it `name`."""
    if isinstance(wanted, type) and is_dataclass(wanted):
        return dataclass_from_json(wanted, value)
    if wanted in (int, float, str, bool):
        fits = isinstance(value, int | float) if wanted is float else isinstance(value, wanted)
        if not fits or (isinstance(value, bool) and wanted is not bool):
            raise ValueError(f"{name} is {str(value)[:40]!r}, expected {wanted.__name__}")
        return wanted(value)
    kind, inside = get_origin(wanted), get_args(wanted)
    if wanted is Any or kind in (dict, list) or (kind is tuple and float not in inside):
        return _nested(kind, inside, value, name)
    array = np.asarray(value, np.float64)  # what is left are rows and matrices of numbers
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return array if "ndarray" in str(wanted).lower() else tuple(array.tolist())


def _nested(kind: Any, inside: tuple[Any, ...], value: Any, name: str) -> Any:
    """A dict, a list or a tuple, each value of its own type, or anything at all."""
    if kind is None:
        return value
    if kind is dict and isinstance(value, dict):
        return {str(k): value_from_json(inside[1], v, f"{name}.{k}") for k, v in value.items()}
    if kind is dict or not isinstance(value, list):
        raise ValueError(f"{name} is {str(value)[:40]!r}")
    types = inside if kind is tuple and inside[-1] is not ... else inside[:1] * len(value)
    return kind(value_from_json(t, v, name) for t, v in zip(types, value, strict=True))
