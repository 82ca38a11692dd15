"""ScanNet's table of raw label ids and their NYU40 classes."""

from __future__ import annotations

import csv
from pathlib import Path

from ..errors import InputError
from ..textfile import read_text
from .sequence import LabelClass

_TABLE_NAME = "scannetv2-labels.combined.tsv"
_LEVELS_UP = 4


def find_label_table(path: Path) -> Path | None:
    """scannetv2-labels.combined.tsv in the folder or one of the four above it."""
    folders = [path.resolve(), *path.resolve().parents][: _LEVELS_UP + 1]
    return next((f / _TABLE_NAME for f in folders if (f / _TABLE_NAME).is_file()), None)


def read_nyu40_classes(path: Path) -> tuple[LabelClass, ...]:
    """The NYU40 classes, each with the raw ids that belong to it. Raises InputError for another table."""
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
