"""Under which name, and whether unchanged, the file of an image can serve as a frame."""

import unicodedata
from collections.abc import Sequence
from pathlib import Path

from ...formats.errors import InputError
from ...formats.images import is_plain

WRITTEN_SUFFIXES = (".jpg", ".jpeg", ".png")
_LONGEST_NAME = 255
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Unicode's control characters, halves of pairs (so Python shows bytes that are no UTF-8), and line breaks."""


def written_name(name: str) -> str:
    """The name under which a frame is written: its own; formats that are not written here become .png."""
    return name if Path(name).suffix.lower() in WRITTEN_SUFFIXES else f"{name}.png"


def written_names(names: Sequence[str], root: Path) -> tuple[str, ...]:
    """`written_name` of each. Raises InputError, naming the file, where a run could not keep one of them.

    A run stores names as UTF-8 in JSON and in COLMAP's files, one a line, and each frame in a file of its name.
    """
    written: dict[str, str] = {}
    for name in names:
        frame = written_name(name)
        if any(unicodedata.category(c) in _NOT_IN_NAMES for c in frame):
            raise InputError(
                f"{root}: the name {name!r} holds a line break, a control character or no UTF-8: rename it"
            )
        if len(frame.encode("utf-8")) > _LONGEST_NAME:
            raise InputError(f"{root}: the name {name!r} is longer than {_LONGEST_NAME} bytes: rename the image")
        if frame in written:
            raise InputError(f"{root}: {written[frame]!r} and {name!r} would both become {frame!r}: rename one of them")
        written[frame] = name
    return tuple(written)


def reusable(path: Path) -> bool:
    """Whether the file itself can be the frame: other programs see it as it is seen here."""
    return path.suffix.lower() in WRITTEN_SUFFIXES and is_plain(path)
