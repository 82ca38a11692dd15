"""Class names: the files in which data sets keep them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import InputError
from ..jsonfile import read_json_object
from .sequence import LabelClass

_VOID_NAMES = frozenset({"none", "void", "undefined", "unlabeled", "unlabelled", "unknown", "ignore"})


def read_classes_json(path: Path) -> tuple[LabelClass, ...]:
    """Classes of `{"classes": [{"id": 3, "name": "sofa", "color": [r, g, b]}, ...]}` by id, without the void ones.

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
