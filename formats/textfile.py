"""Text files: rows of numbers, JSON and TOML, read with a limit and with the place of an error."""

import codecs
import csv
import io
import json
import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from xml.etree.ElementTree import Element, iterparse

import numpy as np
from numpy.typing import NDArray

from .atomic import write_text
from .errors import InputError
from .reading import parsing, read_bytes

MAX_JSON_BYTES = 32 * 1024 * 1024
MAX_OWN_JSON_BYTES = 256 * 1024 * 1024
"""Of a file of a run: a manifest of 400,000 keyframes. Taken apart it needs ten times its size."""
MAX_TOML_BYTES = 1024 * 1024
MAX_XML_BYTES = 16 * 1024 * 1024
_DEEPEST_XML = 64
_MAX_DIGITS = 40
_DEEPEST_KEY, _KEY_ENDS = 64, re.compile(r"[=\n,\[{]")
_NO_KEY = re.compile(
    r"""#[^\n]*|\"{3}(?:[^\\]|\\.)*?(?:\"{3}|\Z)|'{3}.*?(?:'{3}|\Z)|"(?:[^"\\\n]|\\.)*"?|'[^'\n]*'?""", re.DOTALL
)
"""A comment or a string of TOML: dots in it divide no key. One that does not end goes as far as it can, because looking
for its end again from each quote takes the square of the length."""
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")

MAX_TEXT_BYTES = 48 * 1024 * 1024
"""150,000 poses of 16 numbers with all their digits. Taken apart into words, text needs twenty times its size."""

_COMMENT = re.compile(r"^\s*//|(?:^|\s)#")
_DIVIDERS = (";", "\t", ",")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_PUNCTUATION = re.compile(r"[^a-z0-9]")


def read_text(path: Path, limit: int | None = MAX_TEXT_BYTES) -> str:
    """Read the text of a UTF-8 file, or one of UTF-16 that begins with its mark, as PowerShell writes.

    Raises InputError when it is missing, binary, or larger than `limit` bytes.
    """
    data = read_bytes(path, limit)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.removeprefix(codecs.BOM_UTF8).decode("utf-16" if is_wide else "utf-8", errors="replace")
    if "\0" in text[:4096]:
        raise InputError(f"{path} is not a text file: check that it is the right one")
    return text


@dataclass(frozen=True)
class Fields:
    """Rows of a text table, and its headings in lower case without units and punctuation; () where it has none."""

    headings: tuple[str, ...]
    rows: list[list[str]]

    def column(self, *names: str) -> int | None:
        """Return the number of the column that has one of these headings; None without any."""
        return next((self.headings.index(name) for name in names if name in self.headings), None)


def read_fields(path: Path) -> Fields:
    """Read the fields of a text table, whatever divides them: semicolons, tabs, commas or blanks, by the first line of
    data; then commas may be those of decimal numbers.

    Empty lines and comments are left out. A comment begins with # or // at the start of a line, or with # after a
    blank. Headings are a first line without a number, or the last comment before the data if it has as many fields.
    Raises InputError as `read_text`, and for fields of quotes that do not end.
    """
    return fields_of(read_text(path), path)


def fields_of(text: str, path: Path) -> Fields:
    """Read the fields of a table as `read_fields` does; `path` is for errors."""
    data: list[str] = []
    said = ""
    for line in text.splitlines():
        content = _COMMENT.split(line, maxsplit=1)[0].strip()
        if content:
            data.append(content)
        elif not data and line.strip():
            said = line.strip().lstrip("#/ \t")
    second = data[min(1, len(data) - 1)] if data else ""  # the first may state a projection, or headings
    divider = next((mark for mark in _DIVIDERS if mark in second), None)
    with parsing(path, "table"):
        rows = [row for row in (_divided(line, divider) for line in data) if row]
        names = _divided(said, divider)
    if len(rows) > 1 and not any(map(is_number, rows[0])):
        names, rows = rows[0], rows[1:]
    elif not rows or len(names) != len(rows[0]) or any(map(is_number, names)):
        names = []
    headings = (name.partition("[")[0].partition("(")[0].lower() for name in names)
    return Fields(tuple(_PUNCTUATION.sub("", name) for name in headings), rows)


def _divided(line: str, divider: str | None) -> list[str]:
    if divider is None or divider not in line:
        return line.split()
    fields = next(csv.reader([line], delimiter=divider, skipinitialspace=True)) if '"' in line else line.split(divider)
    fields = [field.strip() for field in fields]
    if divider != ",":
        fields = [f.replace(",", ".") if _DECIMAL_COMMA.fullmatch(f) else f for f in fields]
    while fields and not fields[-1]:
        fields.pop()
    words = [field.split() for field in fields]
    # Blanks may divide as well: 1 0 0, 0 1 0.
    mixed = any(len(part) > 1 and all(map(is_number, part)) for part in words)
    return [word for part in words for word in part] if mixed else fields


def read_rows(path: Path) -> list[list[str]]:
    """Read the rows of a text table as `read_fields` does."""
    return read_fields(path).rows


def is_number(field: str) -> bool:
    """Return whether a field of a table is a number, as Python writes them."""
    try:
        float(field)
    except ValueError:
        return False
    return True


def read_table(path: Path, columns: int | None = None) -> NDArray[np.float64]:
    """Read (rows, columns) float64 of a text table; with `columns` None, as many as the first row has. Raises
    InputError for an empty file, and as `numbers_in`."""
    rows = read_rows(path)
    if not rows:
        raise InputError(f"{path} holds no numbers: check that it was written completely")
    return numbers_in(rows, range(columns or len(rows[0])), path)


def numbers_in(rows: list[list[str]], columns: Sequence[int], path: Path) -> NDArray[np.float64]:
    """Return (N, len(columns)) of these columns. Raises InputError that names the first row which lacks one, or has a
    field there that is no number."""
    for i, row in enumerate(rows):
        if len(row) <= max(columns):
            raise InputError(
                f"{path}: row {i + 1} has {len(row)} numbers, expected {max(columns) + 1}: is the file cut short?"
            )
    try:
        return np.array([[row[c] for c in columns] for row in rows], np.float64).reshape(len(rows), len(columns))
    except ValueError as error:
        raise InputError(f"{path}: {str(error)[:200]}: every field must be a number") from error


def write_json(path: Path, value: Any) -> None:
    """Atomically write indented JSON. Raises ValueError for NaN, InputError when the disk refuses."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: Path, limit: int | None = MAX_JSON_BYTES, *, allow_nan: bool = False) -> Any:
    """Read a JSON file: numbers must be finite and of at most 40 digits, texts valid Unicode.

    With `allow_nan` NaN and Infinity pass, which many programs write into poses they have lost.

    Raises InputError when it is missing, larger than `limit` bytes (None: of any size), damaged, or nested too deep.
    """
    text = read_text(path, limit)
    with parsing(path, "valid JSON", "was it cut short or edited by hand?"):
        value = json.loads(
            text, parse_constant=float if allow_nan else _refuse, parse_float=_finite, parse_int=_integer
        )
        if _HALF_CHARACTER.search(text):  # half of a pair cannot be written anywhere: neither in a path nor in a file
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    return value


def read_json_object(path: Path, limit: int | None = MAX_JSON_BYTES, *, allow_nan: bool = False) -> dict[str, Any]:
    """Read the object in a JSON file. Raises InputError as `read_json`, and when it holds something else."""
    value = read_json(path, limit, allow_nan=allow_nan)
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}, expected an object in braces")
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read the table in a TOML file. Raises InputError when it is missing, too large, damaged or nested too deep."""
    text = read_text(path, MAX_TOML_BYTES)
    with parsing(path, "valid TOML", "correct it"):
        if any(part.count(".") > _DEEPEST_KEY for part in _KEY_ENDS.split(_NO_KEY.sub("", text))):
            raise ValueError("a key of too many parts")  # tomllib takes the square of their number in time
        return tomllib.loads(text)


def read_xml(path: Path, limit: int = MAX_XML_BYTES) -> Element:
    """Read the root element of an XML file. Entities are bounded by expat, external ones it does not fetch.

    Raises InputError when the file is missing, larger than `limit` bytes, damaged or nested too deep.
    """
    data, depth, root = read_bytes(path, limit), 0, None
    with parsing(path, "valid XML"):
        for event, element in iterparse(io.BytesIO(data), ("start", "end")):
            root = element if root is None else root
            depth += 1 if event == "start" else -1
            if depth > _DEEPEST_XML:
                raise ValueError(f"it is nested more than {_DEEPEST_XML} deep")
    if root is None:
        raise InputError(f"{path} holds no XML: export it again")
    return root


def _refuse(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number in JSON")


def _finite(digits: str) -> float:
    value = float(digits)
    return value if math.isfinite(value) else _refuse(digits[:_MAX_DIGITS])


def _integer(digits: str) -> int:
    return int(digits) if len(digits) <= _MAX_DIGITS else _refuse(f"one of {len(digits)} digits")


def number(table: dict[str, Any], path: Path, *names: str) -> float:
    """Return the number under the first of these names. Raises InputError when none is there, or it is no number."""
    value = optional_number(table, path, *names)
    if value is None:
        raise InputError(f"{path} lacks {' or '.join(repr(n) for n in names)}: add it")
    return value


def optional_number(table: dict[str, Any], path: Path, *names: str) -> float | None:
    """Return the first number found under `names`, None without any. Raises InputError for other values."""
    name = next((n for n in names if table.get(n) is not None), None)
    if name is None:
        return None
    value = table[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{path}: {name!r} is {str(value)[:80]!r}, expected a number")
    return float(value)
