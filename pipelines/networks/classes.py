"""Tables of class names beside label images, as data sets write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ...formats.jsonfile import read_json
from ...formats.reading import parsing
from ...formats.textfile import read_text

VOID_NAMES = frozenset({"void", "none", "unknown", "undefined", "unlabeled", "unlabelled", "ignore"})
_FILES = ("classes.json", "info_semantic.json", "classes.txt", "labels.txt", "classes_used.txt")
_MAX_BYTES = 16 << 20
MAX_ID = 65535


@dataclass(frozen=True)
class NamedClass:
    """Name and, where the table has one, display colour of a stored id."""

    name: str
    color: tuple[int, int, int] | None = None

    @property
    def is_void(self) -> bool:
        return self.name.strip().lower() in VOID_NAMES


def find_class_table(label_folder: Path) -> Path | None:
    """The table in the label folder or the one above it; None when there is none."""
    candidates = (folder / name for folder in (label_folder, label_folder.parent) for name in _FILES)
    return next((path for path in candidates if path.is_file()), None)


def read_class_table(path: Path) -> dict[int, NamedClass]:
    """id → class. JSON: {"classes": [{"id", "name", "color"?}]}, such a list, a list of names, or {"id": "name"};
    text: a name a line (ids from 0) up to the first empty line, or `id name [anything]` a line; # begins a comment.
    Raises InputError.
    """
    stored = read_json(path, _MAX_BYTES) if path.suffix == ".json" else read_text(path, _MAX_BYTES)
    with parsing(path, "table of classes", "write a list of {id, name}"):
        table = _from_text(stored) if isinstance(stored, str) else _from_json(stored)
    if not table or min(table) < 0 or max(table) > MAX_ID:
        raise InputError(f"{path}: class ids must be in 0..{MAX_ID} and at least one is needed")
    return table


def _from_json(value: Any) -> dict[int, NamedClass]:
    if isinstance(value, dict) and "classes" in value:
        value = value["classes"]
    if isinstance(value, dict):
        return {int(k): NamedClass(str(v)) for k, v in value.items()}
    table = {}
    for i, row in enumerate(value):
        if isinstance(row, str):
            table[i] = NamedClass(row)
        else:
            table[int(row["id"])] = NamedClass(str(row["name"]), _color(row.get("color")))
    return table


def _color(value: Any) -> tuple[int, int, int] | None:
    if value is None:
        return None
    red, green, blue = (min(max(int(v), 0), 255) for v in value)
    return red, green, blue


def _from_text(text: str) -> dict[int, NamedClass]:
    lines = [line.split("#")[0].strip() for line in text.strip().splitlines() if not line.startswith("#")]
    # Prose may follow the names after an empty line, as in the lists that come with some networks.
    lines = lines[: lines.index("")] if "" in lines else lines
    rows = [line.split() for line in lines]
    if all(len(r) >= 2 and r[0].isdecimal() for r in rows):
        return {int(r[0]): NamedClass(r[1]) for r in rows}
    return {i: NamedClass(line) for i, line in enumerate(lines)}
