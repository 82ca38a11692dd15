"""Paths that can be written into files, and paths that a file names, kept inside the folder it belongs to."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Iterable, Sequence
from pathlib import Path

from .errors import InputError

_LONGEST_NAME, _LONGEST_PATH = 255, 4000
"""Bytes that Linux takes for a part of a path, and a little less than it takes for the whole."""


def is_unicode(text: str) -> bool:
    """Whether a text can be written as UTF-8: names on disk that are no UTF-8 come as lone surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def require_unicode(path: Path) -> None:
    """Raise InputError for a path that no JSON or text file can hold."""
    if not is_unicode(str(path)):
        raise InputError(f"{path}: a name in this path is no valid UTF-8, as of an old disk or ZIP file. Rename it")


def require_listable(paths: Iterable[Path]) -> None:
    """Raise InputError for paths that a text file of one path a line cannot hold."""
    for path in paths:
        require_unicode(path.resolve())
        if "\n" in str(path.resolve()):
            raise InputError(f"{path}: a name in this path holds a line break: rename it")


def inside(root: Path, relative: str, named_by: Path) -> Path:
    """`root / relative`, where `named_by` is the file that says so.

    Raises InputError when the name leads out of `root`, by `..` or as an absolute path: data from others must not
    reach into the rest of the disk. Links are followed: whoever may make one in the folder has the disk already.
    """
    name = os.path.normpath(relative)  # so that no `..` is left that would be looked up behind a link
    try:
        long = len(os.fsencode(root / name)) > _LONGEST_PATH
        long = long or any(len(os.fsencode(part)) > _LONGEST_NAME for part in name.split("/"))
    except ValueError:
        long = True  # half a character, which no path can hold
    if long or "\0" in relative or os.path.isabs(name) or name.split("/")[0] == "..":
        raise InputError(f"{named_by} names the file {relative[:300]!r}, outside {root}: correct the entry")
    return root / name


def named_file(places: Sequence[Path], name: str, named_by: Path, shorten: bool = True) -> Path | None:
    """The file in one of `places` with the path `name`, or its longest end that is there; None without even one of the
    bare name.

    For names written on another machine: absolute, with backslashes, or seen from another folder. What is returned
    lies in one of `places`, whatever the name. Without `shorten` only roots and leading `..` are left off. Raises
    InputError for a name too long.
    """
    parts = posixpath.normpath(name.replace("\\", "/")).split("/")
    parts = [part for part in parts if part not in ("", ".", "..") and not part.endswith(":")]
    for first in range(len(parts) if shorten else min(len(parts), 1)):
        files = (inside(place, "/".join(parts[first:]), named_by) for place in places)
        if found := next((file for file in files if file.is_file()), None):
            return found
    return None
