"""Whether the images of a folder are of one camera, by all that their headers say."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.exif import ExifLens
from msgs_slam.formats.images import Header, read_header

_ALIKE = 1.05
"""Focal lengths that differ by less are one: EXIF rounds to whole millimetres, which are 4 % of 25, and the focus moves
the lens by 2 to 3 %."""
_MOST_NAMED = 4
_Key = Callable[[ExifLens], float | None]


@dataclass(frozen=True)
class Headers:
    """Headers of the images that can be read, by name, and why the others cannot."""

    of: Mapping[str, Header]
    unreadable: Mapping[str, str]

    def focal_px(self, width: int, height: int) -> float | None:
        """Median focal length, in pixels of an image of width x height, of the images that state one in EXIF."""
        lenses = [header.lens for header in self.of.values()]
        some = [lens for lens in lenses if lens.equivalent] or lenses
        known = [focal for lens in some if (focal := lens.focal_px(width, height)) is not None]
        return float(np.median(known)) if known else None

    def warn_of_cameras(self, warn: Callable[[str], None]) -> None:
        """Report images of several makes or models, which are taken as one camera where their focal lengths agree."""
        cameras = Counter(h.lens.camera for h in self.of.values() if h.lens.camera).most_common()
        if len(cameras) > 1:
            told = ", ".join(f"{count} by {name}" for name, count in cameras[:_MOST_NAMED])
            warn(
                f"by their EXIF the images were taken with {len(cameras)} cameras ({told}), which are treated as one: "
                "if their lenses differ, keep the images of one camera together"
            )


def read_headers(folder: Path, images: Mapping[str, Path]) -> Headers:
    """Headers of these images of a folder. Raises InputError where none of them can be read."""
    found: dict[str, Header] = {}
    unreadable: dict[str, str] = {}
    for name, path in images.items():
        try:
            found[name] = read_header(path)
        except InputError as error:
            unreadable[name] = str(error)
    if not found:
        raise InputError(
            f"none of the {len(images)} images of {folder} can be read: {next(iter(unreadable.values()), '')}"
        )
    return Headers(found, unreadable)


def require_one_lens(folder: Path, headers: Headers) -> None:
    """Raise InputError where EXIF states several focal lengths, or crops, of images of one size.

    What each image says in the same way is compared: 35 mm equivalents, else the focal length by pixel pitch, else
    that in mm of one model of camera. Programs disagree on whether digital zoom is in the equivalent, so it is compared
    among images of the same focal length in mm.
    """
    lenses = {name: header.lens for name, header in headers.of.items()}
    _require_alike(folder, lenses, lambda e: e.equivalent, "a focal length of {:.3g} mm (35 mm equivalent)")
    rest = {n: e for n, e in lenses.items() if not e.equivalent}
    _require_alike(folder, rest, lambda e: e.by_pitch, "a focal length of {:.3g} mm (35 mm equivalent)")
    rest = {n: e for n, e in rest.items() if not e.by_pitch}
    for camera in {e.camera for e in rest.values()}:
        same = {n: e for n, e in rest.items() if e.camera == camera}
        _require_alike(folder, same, lambda e: e.focal_mm, "a focal length of {:.3g} mm")
    for focal in {e.focal_mm for e in lenses.values()}:
        same = {n: e for n, e in lenses.items() if e.focal_mm == focal}
        _require_alike(folder, same, lambda e: e.zoom, "a digital zoom of {:.3g}")


def _require_alike(folder: Path, lenses: Mapping[str, ExifLens], key: _Key, what: str) -> None:
    values = {name: value for name, lens in lenses.items() if (value := key(lens))}
    groups: list[list[str]] = []
    for name in sorted(values, key=lambda n: values[n]):
        if not groups or values[name] > _ALIKE * values[groups[-1][0]]:
            groups.append([])
        groups[-1].append(name)
    if len(groups) < 2:
        return
    told = [_told(group, values, what) for group in sorted(groups, key=len, reverse=True)[:_MOST_NAMED]]
    more = f"; and {len(groups) - _MOST_NAMED} more" if len(groups) > _MOST_NAMED else ""
    raise InputError(
        f"by their EXIF the images of {folder} were taken with {len(groups)} lenses or zooms: {'; '.join(told)}{more}. "
        "Keep the images of one lens and zoom together. If the EXIF is wrong, remove it from the images"
    )


def _told(group: list[str], values: Mapping[str, float], what: str) -> str:
    """A group of images in words: how many, with which value, and the first of them."""
    first = [name for name in values if name in group][:2]
    value = what.format(float(np.median([values[name] for name in group])))
    return f"{len(group)} with {value} ({', '.join(first)}{', …' if len(group) > len(first) else ''})"
