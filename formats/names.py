"""Names of files as different programs spell them: in another Unicode normal form or case, with other folders or none,
with backslashes, with another suffix or none."""

import posixpath
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath


def folded(text: str) -> str:
    """Return a text that is the same for spellings which differ in case or in Unicode's normal form only."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())


def path_parts(name: str) -> list[str]:
    """Return folders and file name of a path of any system, without roots, drives, `.` and leading `..`."""
    parts = posixpath.normpath(name.replace("\\", "/")).split("/")
    return [part for part in parts if part not in ("", ".", "..") and not part.endswith(":")]


def stem(name: str) -> str:
    """Return a path's file name without its suffix."""
    return PurePosixPath(name.replace("\\", "/")).stem


def match_names(wanted: Sequence[str], having: Sequence[str]) -> list[int | None]:
    """Find for each wanted path the index of the one that means the same file; None without any, or where several fit
    alike.

    File names must agree but for suffix, case and normal form. Of several, that with the longest common end of the
    path is taken, then that with the same spelling. None of them is of two wanted paths.
    """
    index: dict[str, list[int]] = defaultdict(list)
    for row, name in enumerate(having):
        for key in _keys(name):
            index[key].append(row)
    best = [_best((*_likeness(name, having[k]), k) for key in _keys(name) for k in index[key]) for name in wanted]
    claims: dict[int, list[tuple[int, ...]]] = defaultdict(list)
    for i, found in enumerate(best):
        if found is not None:
            claims[found[-1]].append((*found[:-1], i))
    owner = {row: found[-1] for row, several in claims.items() if (found := _best(several)) is not None}
    return [None if f is None or owner.get(f[-1]) != i else f[-1] for i, f in enumerate(best)]


def _keys(name: str) -> set[str]:
    """A name may have lost its suffix, or what looks like one may be part of it."""
    file = (path_parts(name) or [""])[-1]
    return {folded(file), folded(stem(file))}


def _best(found: Iterable[tuple[int, ...]]) -> tuple[int, ...] | None:
    """The likest, None where two are: rows of a likeness and a number."""
    ranked = sorted(set(found), reverse=True)
    return ranked[0] if ranked and (len(ranked) == 1 or ranked[0][:-1] != ranked[1][:-1]) else None


def _likeness(a: str, b: str) -> tuple[int, int, int]:
    """Common folders at the end of two paths whose names agree, whether the suffix, and how far the spelling does."""
    first, second = path_parts(a)[::-1], path_parts(b)[::-1]
    common = exact = 0
    for x, y in zip(first[1:], second[1:], strict=False):
        if folded(x) != folded(y):
            break
        common += 1
        exact += x == y
    file, other = (first or [""])[0], (second or [""])[0]
    return common, int(folded(Path(file).suffix) == folded(Path(other).suffix)), exact + (stem(file) == stem(other))
