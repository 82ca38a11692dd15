"""Which file of a folder belongs to which frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.images import natural_key
from ...formats.reading import home_expanded, reaching
from ..types import Frame, Intrinsics

_KINDS = r"(colou?r|rgb|image|img|depth|disp|labels?|semantic|segmentation|class|conf|confidence)"
_PREFIX = re.compile(rf"^{_KINDS}[._-]", re.IGNORECASE)
_SUFFIX = re.compile(rf"[._-]{_KINDS}$", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(\d+)(?!.*\d)")


def frame_key(file_name: str) -> str:
    """Return the key shared by files of one instant: the stem without words like `.color` or `depth_`."""
    return _SUFFIX.sub("", _PREFIX.sub("", Path(file_name).stem)).lower()


def find_folder(given: str, source: Path, names: tuple[str, ...], suffixes: tuple[str, ...]) -> Path:
    """The folder of maps: `given` or a folder named so inside it; without `given`, such a folder beside the source.

    Raises InputError when there is none that holds files with one of `suffixes`.
    """
    roots = [home_expanded(given)] if given else [source.parent, source]
    candidates = [root / name for root in roots for name in names]
    candidates += [home_expanded(given)] if given else [source]
    for folder in candidates:
        with reaching(folder):
            if folder.is_dir() and _list(folder, suffixes, names):
                return folder
    looked = ", ".join(str(c) for c in candidates)
    raise InputError(
        f"no folder with {names[0]} files ({', '.join(suffixes)}) found; looked in {looked}. "
        f"Give the folder as files:FOLDER"
    )


def match_files(
    folder: Path, suffixes: tuple[str, ...], names: tuple[str, ...], frames: list[Frame], is_video: bool
) -> dict[int, Path]:
    """Frame id → file. An image folder matches by name, then by the last number in it; a video by source index.

    Raises InputError when no frame finds a file.
    """
    files = _list(folder, suffixes, names)
    by_key = {frame_key(p.name): p for p in files}
    by_number = {int(m.group(1)): p for p in files if (m := _LAST_NUMBER.search(p.stem))}
    found = {}
    for frame in frames:
        if is_video:
            path = by_number.get(frame.source_index)
        else:
            number = _LAST_NUMBER.search(Path(frame.name).stem)
            path = by_key.get(frame_key(frame.name)) or (by_number.get(int(number.group(1))) if number else None)
        if path is not None:
            found[frame.id] = path
    if not found:
        rule = "the frame's number in the video" if is_video else "the image's name"
        raise InputError(
            f"{folder}: none of its {len(files)} files ({files[0].name} …) belongs to a frame "
            f"({frames[0].name} …). Name each file by {rule}"
        )
    return found


def as_read(array: NDArray, turn: int, frame: Intrinsics) -> NDArray:
    """A map (h, w) of an upright photo, turned as the photo is; one that lies already as the frames do stays."""
    is_turned = turn % 2 == 0 or (array.shape[1] > array.shape[0]) != (frame.width > frame.height)
    return np.rot90(array, turn) if turn and is_turned else array


def _list(folder: Path, suffixes: tuple[str, ...], names: tuple[str, ...]) -> list[Path]:
    """The map files of a folder; where several kinds are mixed, those that carry one of `names`."""
    files = sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and not p.name.startswith(".")),
        key=lambda p: natural_key(p.name),
    )
    marked = [p for p in files if any(re.search(rf"(^|[._-]){n}s?([._-]|$)", p.stem.lower()) for n in names)]
    return marked or files
