"""Headers of images: their sizes, turns, colours and lenses, and whether all are of one camera."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...formats.errors import InputError
from ...formats.exif import QUARTER_TURNS, ExifLens
from ...formats.images import UNUSABLE, Header, read_deep, read_header

_ALIKE = 1.05
"""Focal lengths that differ by less are one: EXIF rounds to whole millimetres, which are 4 % of 25, and the focus moves
the lens by 2 to 3 %."""
_MAX_NAMED = 4
_MOST = 0.8
"""Of the images of a folder: if so many are of one size, the others are no part of it (screenshots, thumbnails)."""
_SAMPLED_IMAGES, _SAMPLED_STEP = 24, 3
_SPAN_PERCENTILES = 0.5, 99.5
_LARGEST_16_BIT = 65535
Size = tuple[int, int]
_Key = Callable[[ExifLens], float | None]


@dataclass(frozen=True)
class Headers:
    """Headers of the images that can be read, by name; the sizes (width, height) of those that are left out, as most
    are of another."""

    of: Mapping[str, Header]
    odd: Mapping[str, Size] = field(default_factory=dict)

    def of_most(self, size: Callable[[Header], Size]) -> Headers:
        """Leave out the images of another size than `_MOST` of them have; none where fewer agree."""
        common, count = Counter(size(header) for header in self.of.values()).most_common(1)[0]
        if count < _MOST * len(self.of):
            return self
        odd = {name: header.size for name, header in self.of.items() if size(header) != common}
        return replace(self, of={n: h for n, h in self.of.items() if n not in odd}, odd={**self.odd, **odd})

    def focal_px(self, width: int, height: int) -> float | None:
        """Median focal length, in pixels of an image of width x height, of the images that state one in EXIF."""
        lenses = [header.lens for header in self.of.values()]
        some = [lens for lens in lenses if lens.equivalent] or lenses
        known = [focal for lens in some if (focal := lens.focal_px(width, height)) is not None]
        return float(np.median(known)) if known else None

    def common_orientation(self) -> int | None:
        """Return the EXIF orientation by which all images are turned, the commonest, where turning each by its own
        would make two sizes of one; None where each is turned by its own.

        A phone that is turned between two photos is one camera only as its sensor lies.
        """
        found = Counter(h.orientation for h in self.of.values())
        differ = len({h.size for h in self.of.values()}) > 1 and len({h.stored for h in self.of.values()}) == 1
        if not differ or not set(found) <= set(QUARTER_TURNS):
            return None
        return min(found, key=lambda o: (-found[o], o))

    def turns_from_upright(self, name: str, common: int | None) -> int:
        """Return the anticlockwise quarter turns by which an image that is turned as all are differs from upright."""
        if common is None or name not in self.of:
            return 0
        return (QUARTER_TURNS[common] - QUARTER_TURNS[self.of[name].orientation]) % 4

    def warn(self, warn: Callable[[str], None]) -> None:
        """Report images of several makes or models, which are treated as one camera, files of several images, unusable
        colour profiles, and images left out for their size."""
        if self.odd:
            width, height = next(iter(self.of.values())).size
            warn(
                f"{len(self.odd)} of {len(self.odd) + len(self.of)} images are left out, as their size is not "
                f"{width}x{height}: {_first(f'{n} ({w}x{h})' for n, (w, h) in self.odd.items())}"
            )
        if unusable := [name for name, h in self.of.items() if h.colours == UNUSABLE]:
            warn(
                f"the colour profile of {len(unusable)} images is damaged, or of another kind of colours; they are "
                f"taken for sRGB: {_first(unusable)}"
            )
        several = [f"{name} ({h.images})" for name, h in self.of.items() if h.images > 1]
        if several:
            warn(
                f"{len(several)} files hold several images, of which the first is used: {several[0]}"
                f"{', …' if len(several) > 1 else ''}"
            )
        if self.common_orientation() is not None:
            warn(
                "some images were taken upright and some sideways, by their EXIF: all are turned as most of them are, "
                "so that they are of one camera"
            )
        cameras = Counter(h.lens.camera for h in self.of.values() if h.lens.camera).most_common()
        if len(cameras) > 1:
            named = ", ".join(f"{count} by {name}" for name, count in cameras[:_MAX_NAMED])
            warn(
                f"by their EXIF the images were taken with {len(cameras)} cameras ({named}), which are treated as one: "
                "if their lenses differ, keep the images of one camera together"
            )


def _first(names: Iterable[str]) -> str:
    some = list(itertools.islice(names, _MAX_NAMED + 1))
    return ", ".join(some[:_MAX_NAMED]) + (", …" if len(some) > _MAX_NAMED else "")


def read_headers(folder: Path, images: Mapping[str, Path]) -> Headers:
    """Headers of these images of a folder. Raises InputError where none of them can be read."""
    found: dict[str, Header] = {}
    reason = ""
    for name, path in images.items():
        try:
            found[name] = read_header(path)
        except InputError as error:
            reason = reason or str(error)
    if not found:
        raise InputError(f"none of the {len(images)} images of {folder} can be read: {reason}")
    return Headers(found)


def common_span(headers: Headers, images: Mapping[str, Path]) -> tuple[float, float] | None:
    """Values that become black and white in all images of more than 8 bits; None where they use most of 16 bits.

    From a half to 99.5 % of the pixels of evenly chosen images: grey of 10 to 14 bits, or of a thermal camera, fills a
    small part of the range, of which 8 bits would keep a few levels.
    """
    deep = [name for name, header in headers.of.items() if header.is_deep]
    chosen = deep[:: -(-len(deep) // _SAMPLED_IMAGES)] if deep else []
    found = []
    for name in chosen:
        try:
            values = read_deep(images[name])
        except InputError:
            continue  # left out with its reason when it is read
        if values is not None:
            some = values[::_SAMPLED_STEP, ::_SAMPLED_STEP].ravel()
            found.append(some[np.isfinite(some)].astype(np.float64))
    sample = np.concatenate(found) if found else np.zeros(0)
    if not sample.size:
        return None
    low, high = (float(v) for v in np.percentile(sample, _SPAN_PERCENTILES))
    is_whole = sample.min() >= 0 and sample.max() <= _LARGEST_16_BIT and high - low >= _LARGEST_16_BIT / 2
    return None if is_whole or high <= low else (low, high)


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
    found = [_describe_group(group, values, what) for group in sorted(groups, key=len, reverse=True)[:_MAX_NAMED]]
    more = f"; and {len(groups) - _MAX_NAMED} more" if len(groups) > _MAX_NAMED else ""
    raise InputError(
        f"by their EXIF the images of {folder} were taken with {len(groups)} lenses or zooms: "
        f"{'; '.join(found)}{more}. "
        "Keep the images of one lens and zoom together. If the EXIF is wrong, remove it from the images"
    )


def _describe_group(group: list[str], values: Mapping[str, float], what: str) -> str:
    """A group of images in words: how many, with which value, and the first of them."""
    first = [name for name in values if name in group][:2]
    value = what.format(float(np.median([values[name] for name in group])))
    return f"{len(group)} with {value} ({', '.join(first)}{', …' if len(group) > len(first) else ''})"
