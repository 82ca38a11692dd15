"""Tasks, and what they return, as files for any machine: dataclasses of this program, arrays and plain values."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import parsing
from msgs_slam.formats.tensors import load_arrays, save_arrays

_TREE = "tree"
_OURS = "msgs_slam.pipelines."
TASK_MODULES = (
    "msgs_slam.pipelines.frames.tasks",
    "msgs_slam.pipelines.proxy.tasks",
    "msgs_slam.pipelines.mapping.submap_tasks",
    "msgs_slam.pipelines.export.tasks",
)
"""Where functions that do tasks are defined: a run from elsewhere could name any function of the program."""


def save_value(path: Path, value: Any) -> None:
    """One .npz, whole or not at all. Raises TypeError for what is neither of these."""
    arrays: dict[str, NDArray] = {}
    tree = json.dumps(_plain(value, arrays))
    save_arrays(path, {**arrays, _TREE: np.frombuffer(tree.encode(), np.uint8)}, compress=False)


def load_value(path: Path) -> Any:
    """Inverse of `save_value`. Raises InputError for a file that is missing or damaged, or names a class of others."""
    arrays = load_arrays(path, own=True)
    with parsing(path, "value of this program", "delete it"):
        return _value(json.loads(arrays[_TREE].tobytes()), arrays)


def name_of(function: Callable[..., Any] | type) -> str:
    """By which `of_name` finds it again."""
    return f"{function.__module__}:{function.__qualname__}"


def of_name(name: str) -> Any:
    """A function or class that this program's pipelines define. Raises InputError for any other."""
    module, _, attribute = name.partition(":")
    found = getattr(import_module(module), attribute, None) if module.startswith(_OURS) else None
    if getattr(found, "__module__", None) != module:  # what a module only imports, deleting folders for one
        raise InputError(f"{name} is not of this program")
    return found


def _plain(value: Any, arrays: dict[str, NDArray]) -> Any:
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, np.ndarray | np.generic):
        arrays[name := f"a{len(arrays)}"] = np.asarray(value)
        return {"array": name}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_plain(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_plain(k, arrays), _plain(v, arrays)] for k, v in value.items()]}
    if is_dataclass(value) and not isinstance(value, type):
        of = {f.name: _plain(getattr(value, f.name), arrays) for f in fields(value) if f.init}
        return {name_of(type(value)): of}
    raise TypeError(f"{type(value)} does not travel")


def _value(tree: Any, arrays: Mapping[str, NDArray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "path":
        return Path(content)
    if kind == "array":
        return arrays[content]
    if kind in ("tuple", "list"):
        items = [_value(v, arrays) for v in content]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {_value(k, arrays): _value(v, arrays) for k, v in content}
    found = of_name(kind)
    if not (isinstance(found, type) and is_dataclass(found)):
        raise TypeError(f"{kind} is no dataclass")
    return found(**{name: _value(v, arrays) for name, v in content.items()})
