"""Paths that a file names, kept inside the folder the file belongs to."""

from __future__ import annotations

import os
from pathlib import Path

from msgs_slam.formats.errors import InputError

_LONGEST_NAME = 255


def inside(root: Path, relative: str, named_by: Path) -> Path:
    """`root / relative`, where `named_by` is the file that says so.

    Raises InputError when the path leads out of `root`: data from others must not reach into the rest of the disk.
    """
    path = root / relative
    try:
        too_long = any(len(os.fsencode(part)) > _LONGEST_NAME for part in path.parts)
        leads_out = too_long or not path.resolve().is_relative_to(root.resolve())
    except (ValueError, OSError, RuntimeError):
        leads_out = True  # a NUL byte, a name beyond the system's limits, a loop of links
    if leads_out:
        raise InputError(f"{named_by} names the file {relative[:300]!r}, outside {root}: correct the entry")
    return path
