"""The images of a folder: which they are, their order, when they were taken; and files by names that other programs
have for them."""

import os
import posixpath
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .images import IMAGE_SUFFIXES, UNREAD_SUFFIXES, VIDEO_SUFFIXES, exif_time, is_depth_map, read_rgb
from .reading import reaching, resolve_within
from .textfile import is_number, read_rows

_MOST_DIGITS = 18
Listed = dict[Path, dict[str, list[str]]]
"""What is in folders, by its `folded` names."""
_LIST_NAMES = ("timestamps.txt", "times.txt", "rgb.txt")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key under which img2 comes before img10. Raises nothing; equal names have equal keys."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(p), p) if p.isdecimal() and p.isascii() else (1, 0, p) for p in parts)


def list_images(folder: Path) -> list[Path]:
    """List the image files directly in `folder`, in natural order; hidden files are left out.

    Raises InputError when there is no such folder or no image in it.
    """
    folder = Path(folder)
    with reaching(folder):
        if not folder.is_dir():
            raise InputError(f"no such folder: {folder}: check the spelling, and that the disk is mounted")
        files = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    images = [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise InputError(_why_no_images(folder, files))
    return sorted(images, key=lambda p: natural_key(p.name))


def count_images(folder: Path) -> int:
    """Count the image files directly in a folder, hidden ones left out; 0 where there is no such folder."""
    return sum(p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() for p in _visible(folder))


def hint_at_inner_folder(folder: Path, least: int = 2) -> str:
    """Name the folder in `folder`, or in one of its folders, with the most images; "" where none has `least`."""
    inside = [p for p in _visible(folder) if p.is_dir()]
    inside += [deeper for outer in inside for deeper in _visible(outer) if deeper.is_dir()]
    counts = {p.relative_to(folder).as_posix(): count_images(p) for p in inside}
    name = max(counts, key=counts.__getitem__, default="")
    return f"the folder {name}/ in it holds {counts[name]} images: give that" if counts.get(name, 0) >= least else ""


def _visible(folder: Path) -> list[Path]:
    try:
        return [p for p in sorted(folder.iterdir()) if not p.name.startswith(".")]
    except OSError:  # no folder, or none that may be read
        return []


def unused_pictures(images: Collection[Path], others: Collection[Path | None] = ()) -> tuple[str, ...]:
    """Say in words which pictures and videos in the folders of some images are neither these nor `others` that are read
    as well; () where all are.

    A raw file or a clip beside a photograph of the same name is the same shot.
    """
    used, shots, unnamed = {*images, *others}, {path.stem.lower() for path in images}, 0
    unread: list[Path] = []
    for path in (path for folder in sorted({path.parent for path in images}) for path in folder.iterdir()):
        kind = path.suffix.lower()
        if path in used or path.name.startswith(".") or not path.is_file():
            continue
        if kind in IMAGE_SUFFIXES:
            unnamed += not is_depth_map(path)
        elif kind in UNREAD_SUFFIXES | VIDEO_SUFFIXES and path.stem.lower() not in shots:
            unread.append(path)
    notes = []
    if unnamed:
        notes.append(f"{unnamed} images beside the {len(images)} that are read are not named by the data set: left out")
    if unread:
        first = min(unread, key=lambda p: natural_key(p.name)).name
        kinds = Counter(path.suffix.lower() for path in unread)
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        notes.append(
            f"{len(unread)} files of kinds that are not read ({counts}) are left out, {first} first: export images as "
            "JPEG or PNG"
        )
    return tuple(notes)


def _why_no_images(folder: Path, files: list[Path]) -> str:
    unread = sorted({p.suffix.lower() for p in files} & UNREAD_SUFFIXES)
    if unread:
        return f"no readable image in {folder}: {', '.join(unread)} files are not supported, export them as JPEG first"
    videos = sorted(p.name for p in files if p.suffix.lower() in VIDEO_SUFFIXES)
    if videos:
        more = f"{len(videos)} videos, such as {videos[0]}" if videos[1:] else f"the video {videos[0]}"
        return f"no images in {folder}, but {more}: give one of them, or the folder to `msgs-slam batch`"
    hint = hint_at_inner_folder(folder)
    kinds = f"give the folder that holds the images themselves ({', '.join(sorted(IMAGE_SUFFIXES))})"
    return f"no images in {folder} ({len(files)} other files): {hint or kinds}"


def read_image_times(images: list[Path]) -> NDArray[np.float64] | None:
    """Read (N,) seconds at which the images were taken, strictly increasing; None where they are unknown.

    Looks for timestamps.txt, times.txt or rgb.txt in the images' folder, then in the one above where it says a time for
    each: a number a line for each image in order, or for each frame number in the images' names; or lines of
    `seconds name` or `name seconds`. Else EXIF. An image that cannot be read gets a time between its neighbours'.
    Raises InputError for a list that matches the images in none of these ways.
    """
    if not images:
        return None
    listed = times_file(images[0].parent)
    if listed is None:
        return _from_exif(images)
    times = _from_list(listed, images)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise InputError(
            f"{listed}: times must be finite and increase from image to image: sort it, or remove the file"
        )
    return times


def times_file(folder: Path) -> Path | None:
    """Return the list of times that belongs to the images of a folder, None where there is none."""
    with reaching(folder):
        if found := _list_in(folder):
            return found
        above = _list_in(folder.resolve().parent)
    try:
        if above is not None:
            _from_list(above, list_images(folder))
    except InputError:
        return None  # of something else
    return above


def _list_in(folder: Path) -> Path | None:
    return next((folder / name for name in _LIST_NAMES if (folder / name).is_file()), None)


def frame_number(path: Path) -> int | None:
    """Return the last digits in a file name without its suffixes (frame-000012.color.jpg: 12), None without any."""
    digits = re.findall(r"[0-9]+", path.name.split(".")[0])
    return int(digits[-1]) if digits and len(digits[-1]) <= _MOST_DIGITS else None


def _from_list(path: Path, images: list[Path]) -> NDArray[np.float64]:
    rows = read_rows(path)
    try:
        if rows and all(len(row) >= 2 for row in rows):
            time, name = (0, 1) if is_number(rows[0][0]) else (1, 0)
            listed = match_names([str(p) for p in images], [row[name] for row in rows])
            missing = next((p.name for p, k in zip(images, listed, strict=True) if k is None), None)
            if missing is not None:
                raise InputError(f"{path}: no time for {missing!r}: give one line of `seconds name` for each image")
            return np.array([float(rows[k][time]) for k in listed if k is not None], dtype=np.float64)
        times = np.array([float(row[0]) for row in rows], dtype=np.float64)
    except ValueError as error:
        raise InputError(
            f"{path}: a line states no seconds ({error}): give one line of `seconds name` for each image"
        ) from error
    if len(times) == len(images):
        return times
    numbers = [frame_number(p) for p in images]
    if all(n is not None and n < len(times) for n in numbers):
        return times[[n for n in numbers if n is not None]]
    raise InputError(
        f"{path} has {len(times)} times for {len(images)} images, and their names hold no row numbers: "
        "give one line for each image, or remove the file"
    )


def _from_exif(images: list[Path]) -> NDArray[np.float64] | None:
    """None where an image states no time, or times do not increase: cameras that write whole seconds say no order."""
    stored = np.full(len(images), np.nan)
    for i, path in enumerate(images):
        with suppress(InputError):  # damaged: left out when it is read, whatever its time
            time = exif_time(path)
            if time is None:
                read_rgb(path)  # refuses one of which the header alone is whole
                return None
            stored[i] = time
    known = np.flatnonzero(np.isfinite(stored))
    if not len(known) or (np.diff(stored[known]) <= 0).any():
        return None
    step = (stored[known[-1]] - stored[known[0]]) / max(known[-1] - known[0], 1) or 1.0
    index = np.arange(len(images))
    times = np.interp(index, known, stored[known])
    times += step * (np.minimum(index - known[0], 0) + np.maximum(index - known[-1], 0))
    return np.asarray(times - times[0])


# Names as different programs spell them: in another Unicode normal form or case, with other folders or none, with
# backslashes, with another suffix or none.


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


def named_file(
    places: Sequence[Path], name: str, named_by: Path, shorten: bool = True, listed: Listed | None = None
) -> Path | None:
    """Return the file in one of `places` with the path `name`, or its longest end that is there; None without even one
    of the bare name.

    For names written on another machine: absolute, with backslashes, seen from another folder, in another Unicode
    normal form, or in another case where one file only fits. What is returned lies in one of `places`, whatever the
    name. Without `shorten` only roots and leading `..` are left off. `listed` keeps the folders' contents from one call
    to the next. Raises InputError for a name too long.
    """
    listed, parts = {} if listed is None else listed, path_parts(name)
    for first in range(len(parts) if shorten else min(len(parts), 1)):
        files = [resolve_within(place, "/".join(parts[first:]), named_by) for place in places]
        if found := next((file for file in files if file.is_file()), None):
            return found
        alike = (_spelled(place, parts[first:], listed) for place in places)
        if found := next((file for file in alike if file is not None), None):
            return found
    return None


def _spelled(folder: Path, parts: Sequence[str], listed: Listed) -> Path | None:
    """The only file below a folder whose path differs in case and normal form alone."""
    for part in parts:
        if folder not in listed:
            inside: dict[str, list[str]] = {}
            for entry in os.listdir(folder) if folder.is_dir() else ():
                inside.setdefault(folded(entry), []).append(entry)
            listed[folder] = inside
        found = listed[folder].get(folded(part), [])
        exact = [entry for entry in found if entry == part] or found
        if len(exact) != 1:
            return None
        folder = folder / exact[0]
    return folder if folder.is_file() else None
