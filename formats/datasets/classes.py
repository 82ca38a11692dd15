"""Classes of label images: the tables in which data sets name them."""

import csv
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..textfile import read_json_object, read_text
from .sequence import LabelClass

_TABLE_NAME = "scannetv2-labels.combined.tsv"
_LEVELS_UP = 4

_VOID_NAMES = frozenset({"none", "void", "undefined", "unlabeled", "unlabelled", "unknown", "ignore"})


def read_classes_json(path: Path) -> tuple[LabelClass, ...]:
    """Read the classes of `{"classes": [{"id": 3, "name": "sofa", "color": [r, g, b]}, ...]}` by id, without the void
    ones.

    The colour may be missing. Void is what is named so (none, void, undefined, unlabeled, unknown, ignore).
    Raises InputError for another shape, an id outside 0..65535, or an id that occurs twice.
    """
    entries = read_json_object(path).get("classes")
    if not isinstance(entries, list) or not entries:
        raise InputError(f'{path} has no list "classes": expected [{{"id": 1, "name": "wall"}}, ...]')
    classes = sorted((_class_of(entry, path) for entry in entries), key=lambda c: c.id)
    ids = [c.id for c in classes]
    if len(set(ids)) != len(ids):
        raise InputError(f"{path}: a class id occurs twice: give each class its own")
    return tuple(c for c in classes if c.name.lower() not in _VOID_NAMES)


def _class_of(entry: Any, path: Path) -> LabelClass:
    id, name = (entry.get("id"), entry.get("name")) if isinstance(entry, dict) else (None, None)
    if isinstance(id, bool) or not isinstance(id, int) or not 0 <= id <= 65535 or not isinstance(name, str):
        raise InputError(f"{path}: {str(entry)[:80]} is no class: expected an id in 0..65535 and a name")
    color = entry.get("color")
    if not (isinstance(color, list) and len(color) == 3 and all(isinstance(v, int) and 0 <= v <= 255 for v in color)):
        return LabelClass(id, name)
    return LabelClass(id, name, (color[0], color[1], color[2]))


def find_label_table(path: Path) -> Path | None:
    """scannetv2-labels.combined.tsv in the folder or one of the four above it."""
    folders = [path.resolve(), *path.resolve().parents][: _LEVELS_UP + 1]
    return next((f / _TABLE_NAME for f in folders if (f / _TABLE_NAME).is_file()), None)


def read_nyu40_classes(path: Path) -> tuple[LabelClass, ...]:
    """Read the NYU40 classes, each with the raw ids that belong to it. Raises InputError for another table."""
    members: dict[tuple[int, str], list[int]] = {}
    rows = csv.DictReader(read_text(path).splitlines(), delimiter="\t")
    try:
        for row in rows:
            if row["nyu40id"] and int(row["nyu40id"]) > 0:
                members.setdefault((int(row["nyu40id"]), row["nyu40class"]), []).append(int(row["id"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not ScanNet's label table ({error}): download it again") from error
    if not members or any(not 0 <= i <= 65535 for ids in members.values() for i in ids):
        raise InputError(f"{path} is not ScanNet's label table: download it again")
    return tuple(LabelClass(ids[0], name, None, tuple(ids[1:])) for (_, name), ids in sorted(members.items()))
