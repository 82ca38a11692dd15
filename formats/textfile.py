"""Small text files of numbers, read with a limit and with the line in the error."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .reading import read_bytes

MAX_TEXT_BYTES = 48 * 1024 * 1024
"""150,000 poses of 16 numbers with all their digits. Taken apart into words, text needs twenty times its size."""

_COMMENT = re.compile(r"^\s*//|(?:^|\s)#")


def read_text(path: Path, most: int | None = MAX_TEXT_BYTES) -> str:
    """The text of a UTF-8 file, or one of UTF-16 that begins with its mark, as PowerShell writes.

    Raises InputError when it is missing, binary, or larger than `most` bytes.
    """
    data = read_bytes(path, most)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.removeprefix(codecs.BOM_UTF8).decode("utf-16" if is_wide else "utf-8", errors="replace")
    if "\0" in text[:4096]:
        raise InputError(f"{path} is not a text file: check that it is the right one")
    return text


def read_rows(path: Path) -> list[list[str]]:
    """The fields of each line, split at blanks and commas; empty lines, comments and a line of headings are left out.

    A comment begins with # or // at the start of a line, or with # after a blank; headings are a first line without
    a number.
    """
    lines = (_COMMENT.split(line, 1)[0].replace(",", " ").split() for line in read_text(path).splitlines())
    rows = [line for line in lines if line]
    return rows[1:] if len(rows) > 1 and not any(map(_is_number, rows[0])) else rows


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def read_table(path: Path, columns: int | None = None) -> NDArray[np.float64]:
    """(rows, columns) float64 of a text table; with `columns` None, as many as the first row has.

    Raises InputError that names the first row of another length or with a field that is no number.
    """
    rows = read_rows(path)
    if not rows:
        raise InputError(f"{path} holds no numbers: check that it was written completely")
    columns = columns or len(rows[0])
    for i, row in enumerate(rows):
        if len(row) < columns:
            raise InputError(f"{path}: row {i + 1} has {len(row)} numbers, expected {columns}: is the file cut short?")
    try:
        return np.array([row[:columns] for row in rows], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: {str(error)[:200]}: every field must be a number") from error
