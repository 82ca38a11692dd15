"""The files of a source: headers of images, whether all are of one camera; lists of videos; and what both have to
report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...formats.errors import InputError, install_extra
from ...formats.image_tags import QUARTER_TURNS
from ...formats.images import UNUSABLE, Header, read_deep, read_header
from ...formats.textfile import read_text
from ...formats.video import VideoReader
from ...formats.video_head import main_track
from ..system.wording import quoted

_LIST_SUFFIX = ".videos"
Warn = Callable[[str], None]
_LONGEST_LIST = 100_000
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


# images ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Headers:
    """Headers of the images that can be read, by name; sizes (width, height) of those of an odd one, left out."""

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
        width, height = next((h.size for h in self.of.values()), (0, 0))  # a container has no files
        odd = [f"{name} ({w}x{h})" for name, (w, h) in self.odd.items()]
        unusable = [name for name, header in self.of.items() if header.colours == UNUSABLE]
        several = [f"{name} ({header.images})" for name, header in self.of.items() if header.images > 1]
        cameras = Counter(h.lens.camera for h in self.of.values() if h.lens.camera).most_common()
        named = ", ".join(f"{count} by {name}" for name, count in cameras[:_MAX_NAMED])
        count, is_sideways = len(odd) + len(self.of), self.common_orientation() is not None
        said = (
            (odd, f"{len(odd)} of {count} images are left out, as their size is not {width}x{height}: {_first(odd)}"),
            (unusable, f"the colour profile of {len(unusable)} images is damaged, or of another kind of colours; they "
             f"are taken for sRGB: {_first(unusable)}"),
            (several, f"{len(several)} files hold several images, of which the first is used: {_first(several, 1)}"),
            (is_sideways, "some images were taken upright and some sideways, by their EXIF: all are turned as most of "
             "them are, so that they are of one camera"),
            (len(cameras) > 1, f"by their EXIF the images were taken with {len(cameras)} cameras ({named}), which are "
             "treated as one: if their lenses differ, keep the images of one camera together"),
        )  # fmt: skip
        for holds, text in said:
            if holds:
                warn(text)


def _first(names: Sequence[str], most: int = _MAX_NAMED) -> str:
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


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
    equivalent = "a focal length of {:.3g} mm (35 mm equivalent)"
    groups: dict[tuple[str, object], dict[str, float | None]] = {}
    for name, header in headers.of.items():
        lens = header.lens
        groups.setdefault(("a digital zoom of {:.3g}", lens.focal_mm), {})[name] = lens.zoom
        if lens.equivalent:
            groups.setdefault((equivalent, "stated"), {})[name] = lens.equivalent
        elif lens.by_pitch:
            groups.setdefault((equivalent, "by pitch"), {})[name] = lens.by_pitch
        else:
            groups.setdefault(("a focal length of {:.3g} mm", lens.camera), {})[name] = lens.focal_mm
    for (what, _), values in groups.items():
        _require_alike(folder, {name: value for name, value in values.items() if value}, what)


def _require_alike(folder: Path, values: Mapping[str, float], what: str) -> None:
    groups: list[list[str]] = []
    for name in sorted(values, key=lambda n: values[n]):
        if not groups or values[name] > _ALIKE * values[groups[-1][0]]:
            groups.append([])
        groups[-1].append(name)
    if len(groups) < 2:
        return
    found = []
    for group in sorted(groups, key=len, reverse=True)[:_MAX_NAMED]:
        first = [name for name in values if name in group][:2]
        value = what.format(float(np.median([values[name] for name in group])))
        found.append(f"{len(group)} with {value} ({', '.join(first)}{', …' if len(group) > len(first) else ''})")
    more = f"; and {len(groups) - _MAX_NAMED} more" if len(groups) > _MAX_NAMED else ""
    raise InputError(
        f"by their EXIF the images of {folder} were taken with {len(groups)} lenses or zooms: "
        f"{'; '.join(found)}{more}. "
        "Keep the images of one lens and zoom together. If the EXIF is wrong, remove it from the images"
    )


# videos ----------------------------------------------------------------------------------------------------


def video_files(path: Path) -> tuple[Path, ...]:
    """The videos that a text file of the suffix .videos names, one a line, from its folder; any other file itself."""
    if path.suffix != _LIST_SUFFIX:
        return (path,)
    lines = [line.strip() for line in read_text(path, _LONGEST_LIST).splitlines()]
    files = tuple(path.parent / line for line in lines if line)
    if not files or _LIST_SUFFIX in {file.suffix for file in files}:
        raise InputError(f"{path} names no videos: write the name of one on each line")
    return files


def require_different(videos: Iterable[Path]) -> None:
    """Raise InputError for a video that is named twice: each of its frames would have a twin that does not move."""
    counts = Counter(video.resolve() for video in videos)
    if twice := next((video for video, times in counts.items() if times > 1), None):
        raise InputError(f"{twice} is given {counts[twice]} times: give each video once")


def warn_of_video(path: Path, reader: VideoReader, warn: Warn) -> None:
    """Report what is unusual about a video that has been read to its end."""
    n, info, decoded, repaired = path.name, reader.info, len(reader.timestamps), reader.repaired_timestamps
    timeless, aspect = repaired == decoded - 1 > 1, reader.display.aspect
    others = [i for i in range(len(reader.tracks)) if i != reader.track]
    said = (
        (reader.tone_mapped, f"{n} is HDR ({reader.hdr}): tone-mapped to the range of ordinary images"),
        (reader.hdr and not reader.tone_mapped,
         f"{n} is HDR ({reader.hdr}), its colours will look flat. To read it in full: {install_extra('hdr')}"),
        (others, _about_tracks(path, reader, others) if others else ""),
        (reader.has_alpha, f"{n} has an alpha channel, which is not read: its background counts as part of the scene. "
         f"To leave it out, make masks with `ffmpeg -i {quoted(n)} -vf alphaextract -start_number 0 "
         "MASKS/%06d.png`, and pass --masks MASKS"),
        (reader.is_truncated, f"{n} is truncated: its header declares {info.frame_count_claimed} frames, {decoded} "
         "decode; going on with those"),
        (reader.interlaced, f"{n} is interlaced: deinterlaced, at the cost of some detail; film progressive where you "
         "can"),
        (aspect != 1, f"{n} has pixels that are not square ({aspect:.3f} times as wide as high): frames are stretched "
         f"to {info.width}x{info.height}, the size in which all pixels given count"),
        (reader.blank_frames, f"{n}: {reader.blank_frames} frames of one flat colour (a fade, or damage) were left "
         "out"),
        (reader.unreadable_frames, f"{n}: {reader.unreadable_frames} damaged frames were left out"),
        (timeless, f"{n} has no timestamps (a raw stream?): {info.fps:g} frames a second are assumed"),
        (repaired and not timeless, f"{n}: {repaired} of {decoded} timestamps were missing or went back (recordings "
         "joined to one file?): the usual step is taken"),
    )  # fmt: skip
    for holds, text in said:
        if holds:
            warn(text)


def _about_tracks(path: Path, reader: VideoReader, others: list[int]) -> str:
    main = main_track(reader.tracks)
    named = [f"track {i} ({track.width}x{track.height})" for i, track in enumerate(reader.tracks, 1)]
    wanted = main if main in others else others[0]
    more = "" if wanted != main else f"; `{install_extra('hdr')}` makes it the one that is read"
    return (
        f"{path.name} holds {len(named)} video tracks: {named[reader.track]} is used, not "
        f"{', '.join(named[i] for i in others)}. To use {named[wanted]}, copy it with "
        f"`ffmpeg -i {quoted(path.name)} -map 0:v:{wanted} -c copy OUT{path.suffix}`{more}"
    )
