"""Small text files of numbers, read with a limit and with the line in the error."""

from __future__ import annotations

import codecs
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.reading import read_bytes

MAX_TEXT_BYTES = 48 * 1024 * 1024
"""150,000 poses of 16 numbers with all their digits. Taken apart into words, text needs twenty times its size."""


def read_text(path: Path, most: int | None = MAX_TEXT_BYTES) -> str:
    """The text of a UTF-8 file. Raises InputError when it is missing, binary, or larger than `most` bytes."""
    text = read_bytes(path, most).removeprefix(codecs.BOM_UTF8).decode("utf-8", errors="replace")
    if "\0" in text[:4096]:
        raise InputError(f"{path} is not a text file: check that it is the right one")
    return text


def read_rows(path: Path) -> list[list[str]]:
    """The fields of each line, split at blanks and commas; empty lines and those that start with # are left out."""
    lines = (line.strip() for line in read_text(path).splitlines())
    return [line.replace(",", " ").split() for line in lines if line and not line.startswith("#")]


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
