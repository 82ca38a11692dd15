"""JSON files: written whole or not at all, and checked before anyone relies on what they hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from formats.atomic import write_text
from formats.errors import InputError
from formats.textfile import read_text


def write_json(path: Path, value: Any) -> None:
    """Atomically write indented JSON. Raises ValueError for NaN, InputError when the disk refuses."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError when it is missing, damaged, or holds something else."""
    try:
        value = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no valid JSON ({error}): was it cut short or edited by hand?") from error
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}, expected an object in braces")
    return value


def number(table: dict[str, Any], path: Path, *names: str) -> float:
    """The number under the first of these names that is there. Raises InputError when none is, or it is no number."""
    value = optional_number(table, path, *names)
    if value is None:
        raise InputError(f"{path} lacks {' or '.join(repr(n) for n in names)}: add it")
    return value


def optional_number(table: dict[str, Any], path: Path, *names: str) -> float | None:
    """As `number`, but None when no such name is there."""
    name = next((n for n in names if table.get(n) is not None), None)
    if name is None:
        return None
    value = table[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{path}: {name!r} is {value!r}, expected a number")
    return float(value)
