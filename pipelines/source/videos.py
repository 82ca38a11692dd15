"""Files of videos: a list of several of one place, and what their readers have to report."""

import shlex
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from ...formats.errors import InputError, install_extra
from ...formats.exif import ExifLens
from ...formats.textfile import read_text
from ...formats.video import VideoReader
from ...formats.video_head import main_track, read_equivalent

LIST_SUFFIX = ".videos"
Warn = Callable[[str], None]
_LONGEST_LIST = 100_000


def video_files(path: Path) -> tuple[Path, ...]:
    """The videos that a text file of the suffix .videos names, one a line, seen from its folder; of any other file
    itself."""
    if path.suffix != LIST_SUFFIX:
        return (path,)
    lines = [line.strip() for line in read_text(path, _LONGEST_LIST).splitlines()]
    files = tuple(path.parent / line for line in lines if line)
    if not files or LIST_SUFFIX in {file.suffix for file in files}:
        raise InputError(f"{path} names no videos: write the name of one on each line")
    return files


def common_focal(videos: Iterable[Path], width: int, height: int) -> float | None:
    """Return the focal length in pixels that the metadata of all videos state alike; None where they do not."""
    stated = {read_equivalent(video) for video in videos}
    return ExifLens(equivalent=stated.pop()).focal_px(width, height) if len(stated) == 1 else None


def require_different(videos: Iterable[Path]) -> None:
    """Raise InputError for a video that is named twice: each of its frames would have a twin that does not move."""
    counts = Counter(video.resolve() for video in videos)
    if twice := next((video for video, times in counts.items() if times > 1), None):
        raise InputError(f"{twice} is given {counts[twice]} times: give each video once")


def warn_of_video(path: Path, reader: VideoReader, warn: Warn) -> None:
    decoded = len(reader.timestamps)
    if reader.tone_mapped:
        warn(f"{path.name} is HDR ({reader.hdr}): tone-mapped to the range of ordinary images")
    elif reader.hdr:
        fix = install_extra("hdr")
        warn(f"{path.name} is HDR ({reader.hdr}), its colours will look flat. To read it in full: {fix}")
    _warn_of_the_rest(path, reader, warn)
    if reader.is_truncated:
        warn(
            f"{path.name} is truncated: its header declares {reader.info.frame_count_claimed} frames, {decoded} "
            "decode; going on with those"
        )
    _warn_of_shape(path, reader, warn)
    if reader.blank_frames:
        warn(f"{path.name}: {reader.blank_frames} frames of one flat colour (a fade, or damage) were left out")
    if reader.unreadable_frames:
        warn(f"{path.name}: {reader.unreadable_frames} damaged frames were left out")
    _warn_of_the_clock(path, reader, warn)


def _warn_of_the_clock(path: Path, reader: VideoReader, warn: Warn) -> None:
    decoded = len(reader.timestamps)
    if reader.repaired_timestamps == decoded - 1 > 1:
        warn(f"{path.name} has no timestamps (a raw stream?): {reader.info.fps:g} frames a second are assumed")
    elif reader.repaired_timestamps:
        warn(f"{path.name}: {reader.repaired_timestamps} of {decoded} timestamps were missing or went back; repaired")
    if reader.restarts:
        warn(
            f"{path.name}: the clock jumps or starts anew {reader.restarts} times (recordings joined to one file?); "
            "going on with the usual time between two frames"
        )


def _warn_of_the_rest(path: Path, reader: VideoReader, warn: Warn) -> None:
    """Report what the file holds beside the frames that are used: other video tracks, an alpha channel."""
    file, main = shlex.quote(path.name), main_track(reader.tracks)
    named = [f"track {i} ({track.width}x{track.height})" for i, track in enumerate(reader.tracks, 1)]
    if others := [i for i in range(len(named)) if i != reader.track]:
        wanted = main if main in others else others[0]
        more = "" if wanted != main else f"; `{install_extra('hdr')}` makes it the one that is read"
        warn(
            f"{path.name} holds {len(named)} video tracks: {named[reader.track]} is used, not "
            f"{', '.join(named[i] for i in others)}. To use {named[wanted]}, copy it with "
            f"`ffmpeg -i {file} -map 0:v:{wanted} -c copy OUT{path.suffix}`{more}"
        )
    if reader.has_alpha:
        warn(
            f"{path.name} has an alpha channel, which is not read: its background counts as part of the scene. To "
            f"leave it out, make masks with `ffmpeg -i {file} -vf alphaextract -start_number 0 MASKS/%06d.png`, and "
            "pass --masks MASKS"
        )


def _warn_of_shape(path: Path, reader: VideoReader, warn: Warn) -> None:
    if reader.interlaced:
        warn(f"{path.name} is interlaced: deinterlaced, at the cost of some detail; film progressive where you can")
    if reader.display.aspect != 1:
        warn(
            f"{path.name} has pixels that are not square ({reader.display.aspect:.3f} times as wide as high): frames "
            f"are stretched to {reader.info.width}x{reader.info.height}, the size in which all pixels given count"
        )
