"""Video files to RGB frames as they are to be shown, with their times, by OpenCV's FFmpeg."""

from __future__ import annotations

import itertools
import math
import os
import statistics
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# FFmpeg speaks to stderr by itself; both variables are read when OpenCV first opens a video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("OPENCV_VIDEOIO_DEBUG", "0")

import cv2

from .errors import InputError, install_extra, shell_word
from .images import IMAGE_SUFFIXES
from .reading import opened, require_unicode
from .video_head import Display, VideoTrack, main_track, mirror_of, pixel_aspect, read_tracks
from .video_streams import AvCapture, has_pyav, interlaced_error, opencv_capture_options, read_facts

MAX_FRAME_PIXELS = 64_000_000
"""A larger frame is taken for a damaged or hostile header (8K video has 33 million)."""

_OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_SNIFFED_BYTES = 4096
_UNKNOWN_RATE = 30.0
_MAX_RATE = 10_000.0
"""A larger one is a clock's unit and no number of frames a second."""
_FEWEST_BYTES = 4
"""Of a frame: a header that declares more frames than the file can hold says nothing."""
_WHOLE = 0.98
"""Of the time that a header states, a file that is not cut off has so much."""
_FIRST_FRAMES = 8
"""Decoded before to see whether a video is interlaced."""
_DOUBTED_FRAMES = 1000
"""Among so many, frames without a picture of their own are looked into."""
_SHORTEST_STEP = 1e-6
_ARCHIVES = (b"PK\3\4", b"Rar!", b"7z\xbc\xaf", b"\x1f\x8b", b"\xfd7zX", b"BZh", b"\x28\xb5\x2f\xfd")
_TAR, _TAR_MARK_AT = b"ustar", 257
_CODECS = {"av01": "AV1", "vvc1": "H.266 (VVC)", "vvi1": "H.266 (VVC)", "apv1": "APV", "evc1": "EVC"}
_DECODED = ("h264", "avc1", "hevc", "hev1", "hvc1", "mp4v", "mjpg", "vp80", "vp90", "vp09")
"""By every OpenCV: a file of these is damaged where it has no frame."""


@dataclass(frozen=True)
class VideoInfo:
    """Metadata of a video file; the size is that of the decoded frames, after rotation.

    `frame_count_claimed` (0 = not said) comes from the header: a truncated file still says what it once held. `fps` is
    the mean rate; single frames may be apart by other times.
    """

    width: int
    height: int
    frame_count_claimed: int
    fps: float


class VideoFrame(NamedTuple):
    """`source_index` counts decoded frames from 0, `timestamp` in seconds from the first, rgb (H, W, 3) uint8."""

    source_index: int
    timestamp: float
    rgb: NDArray[np.uint8]


def probe_video(path: Path) -> VideoInfo:
    """Open a video, decode its first frame and describe it.

    Raises InputError for a missing, empty or text file, and for one in which no image can be decoded.
    """
    with VideoReader(path) as reader:
        # Two frames: OpenCV makes the same picture of all frames that it cannot convert.
        if not list(itertools.islice(reader, 2)):
            raise _undecodable(Path(path), blank=reader.blank_frames)
        return reader.info


class VideoReader(Iterator[VideoFrame]):
    """Iterates over the wanted frames of a video, each a `VideoFrame`.

    `wanted` says by index (a set, a range or a function) which frames to hand out, None for all; the others are
    decoded but not converted to RGB. A turn or mirroring stated in the file is applied, and pixels that are no squares
    are stretched to such. Timestamps are those of the container, so a variable rate is kept; where they are missing, go
    back or jump they are repaired to increase strictly.

    Of `tracks` (of MP4 and Matroska) number `track` is read: without PyAV always the first, and `main_track` otherwise.

    After the end `timestamps` holds the time of every decoded frame and `missing_frames` how many frames the header
    promised beyond those. `repaired_timestamps` counts the repairs, `blank_frames` those wanted
    that show one flat colour and were left out (a fade, or a picture never decoded).
    `hdr` is "HLG" or "PQ" where the file says so, `tone_mapped` whether its frames are then brought to sRGB;
    `interlaced` whether frames are deinterlaced.

    Raises InputError at construction as `probe_video` does, and for interlaced video where it cannot be read, which
    may show later.
    """

    def __init__(self, path: Path, wanted: Callable[[int], bool] | Container[int] | None = None) -> None:
        self._path = Path(path)
        head = _read_video_bytes(self._path)
        self._wanted = _as_predicate(wanted)
        self.tracks = read_tracks(self._path)
        self.track = main_track(self.tracks) if has_pyav() else 0
        stated = self.tracks[self.track] if self.tracks else VideoTrack(0, 0)
        self.interlaced, transfer = read_facts(self._path, _FIRST_FRAMES, self.track) if has_pyav() else (False, "")
        self.has_alpha = stated.has_alpha
        self.hdr = stated.transfer or transfer
        self.tone_mapped = bool(self.hdr) and has_pyav()
        self._capture = self._first_grabbed()
        self._is_grabbed = True
        self.display = _read_display(self._capture, stated)
        self.info = _read_info(self._capture, self._path, self.display, stated)
        self._has_counted = stated.samples > 0 or head.startswith(b"RIFF")
        self._clock = Clock(self.info.fps)
        self._last: NDArray | None = None
        self._is_trusted = False
        self.ended = False
        self.unreadable_frames = self.blank_frames = 0

    def _first_grabbed(self) -> cv2.VideoCapture | AvCapture:
        """The decoder after its first frame: PyAV where OpenCV would fail and it is there."""
        if self.tone_mapped or self.interlaced or self.track:
            by_pyav = AvCapture(self._path, self.hdr, self.interlaced, self.track)
            if self.interlaced and by_pyav.codec == "hevc":
                raise interlaced_error(self._path, by_pyav.codec)
            if by_pyav.isOpened() and by_pyav.grab():
                return by_pyav
            raise _undecodable(self._path)
        capture = _open(self._path)
        if capture.isOpened() and capture.grab():
            return capture
        instead = AvCapture(self._path) if has_pyav() else None
        if instead is not None and instead.isOpened() and instead.grab():
            return instead
        raise _undecodable(self._path, _codec(capture))

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """(frames decoded so far,) seconds."""
        return np.array(self._clock.times, dtype=np.float64)

    @property
    def repaired_timestamps(self) -> int:
        """Frames whose stored time was missing or not after its predecessor's."""
        return self._clock.repairs

    @property
    def missing_frames(self) -> int:
        """Frames that the header claims and the file does not deliver; 0 before the end."""
        return max(0, self.info.frame_count_claimed - len(self._clock.times)) if self.ended else 0

    @property
    def is_truncated(self) -> bool:
        """Whether more is missing than containers count too many in passing; False before the end.

        Most containers state no number of frames but how long they last: then frames that go on to that end are all.
        """
        claimed = self.info.frame_count_claimed
        few = max(2, claimed // 50)
        if self.missing_frames <= few or few < self.repaired_timestamps < len(self._clock.times) - 1:
            return False  # of recordings that were joined to one file the header says nothing
        return self._has_counted or self._clock.times[-1] < _WHOLE * (claimed - 1) / self.info.fps

    def __next__(self) -> VideoFrame:
        while self._is_grabbed or self._capture.grab():
            self._is_grabbed = False
            index = len(self._clock.times)
            timestamp = self._clock.next(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
            if not self._wanted(index):
                continue
            decoded, bgr = self._capture.retrieve()
            if not decoded or bgr is None or not bgr.size:
                self.unreadable_frames += 1
                continue
            is_blank = _is_blank(bgr)
            if is_blank or (self._last is not None and np.array_equal(bgr, self._last)):
                self._require_converted(index)
            self._last = bgr
            if not is_blank:
                return VideoFrame(index, timestamp, self.display.shown(_as_rgb8(bgr)))
            self.blank_frames += 1
        self.ended = True
        self.close()
        raise StopIteration

    def _require_converted(self, index: int) -> None:
        """Ask FFmpeg, once, whether a frame without a picture, or with that of the last one, is what OpenCV makes of
        interlaced ones."""
        if self._is_trusted or index > _DOUBTED_FRAMES or isinstance(self._capture, AvCapture):
            return
        self._is_trusted = True
        if read_facts(self._path, index + 1)[0]:
            raise interlaced_error(self._path, _codec(self._capture), index)

    def close(self) -> None:
        """Release the decoder; iterating further ends at once."""
        self._capture.release()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _as_predicate(wanted: Callable[[int], bool] | Container[int] | None) -> Callable[[int], bool]:
    if wanted is None:
        return lambda index: True
    if callable(wanted):
        return wanted
    return wanted.__contains__


def _read_video_bytes(path: Path) -> bytes:
    """The first bytes. Refuses what is certainly no video before FFmpeg sees it, to say so better than it would."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{path} is a single image, not a video: give the folder that contains the images")
    with opened(path) as file:
        head = file.read(_SNIFFED_BYTES)
    if head.startswith(_ARCHIVES) or head.startswith(_TAR, _TAR_MARK_AT):
        raise InputError(f"{path} is an archive: unpack it first, then give the video or the folder that was in it")
    if b"\0" not in head and _is_text(head):
        raise InputError(f"{path} is a text file, not a video: give a video file or a folder that holds images")
    return head


def _is_text(head: bytes) -> bool:
    try:
        # A multi-byte character may be cut at the end of the sample.
        text = head[: len(head) - 4 if len(head) == _SNIFFED_BYTES else None].decode("utf-8")
    except UnicodeDecodeError:
        return False
    return all(c.isprintable() or c.isspace() for c in text)


def _open(path: Path) -> cv2.VideoCapture:
    require_unicode(path.resolve())  # OpenCV ends the whole process
    level, options = cv2.utils.logging.getLogLevel(), os.environ.get(_OPTIONS_VARIABLE)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    os.environ[_OPTIONS_VARIABLE] = opencv_capture_options()  # OpenCV has no other way to hand them to FFmpeg
    try:
        # Without naming the backend, "img_01.jpg" would open as the start of a numbered image series.
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
        del os.environ[_OPTIONS_VARIABLE]
        if options is not None:
            os.environ[_OPTIONS_VARIABLE] = options
    return capture


def _codec(capture: cv2.VideoCapture | AvCapture) -> str:
    """The four letters of a capture's codec, "" where there is no stream."""
    if isinstance(capture, AvCapture):
        return capture.codec
    letters = int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
    return letters.to_bytes(4, "little").decode("latin-1").strip("\0 ") if capture.isOpened() else ""


def _undecodable(path: Path, codec: str = "", blank: int = 0) -> InputError:
    """That no image comes out; `blank`: so many, all of one flat colour, came out."""
    convert = f"convert it with `ffmpeg -i {shell_word(str(path))} -c:v libx264 OUT.mp4`"
    if codec and codec.lower() not in _DECODED:
        name = _CODECS.get(codec.lower(), codec)
        more = "" if has_pyav() else f"; `{install_extra('hdr')}` brings more decoders"
        return InputError(
            f"no image can be decoded from {path}: there is no decoder for its codec, {name}, or it is damaged: "
            f"{convert}{more}"
        )
    if blank:
        what = f"all {blank} frames of {path} are of one flat colour (a covered lens, or not decoded properly)"
    else:
        what = (
            f"no image can be decoded from {path}: it contains no video stream (audio only?), is damaged, or was not "
            "copied completely"
        )
    return InputError(f"{what}: play it in a video player, and if it plays {convert}")


def _is_blank(image: NDArray) -> bool:
    """Whether all pixels of an image (H, W) or (H, W, C) are the same."""
    some = image[::16, ::16]
    return bool((some == image[0, 0]).all() and (image == image[0, 0]).all())


def _read_display(capture: cv2.VideoCapture | AvCapture, track: VideoTrack) -> Display:
    mirror = mirror_of(track.matrix)
    if mirror.is_mirrored:
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # a decoder knows turns only, and turns such a picture by 180°
    aspect = pixel_aspect(capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN))
    is_turned = mirror.swaps if mirror.is_mirrored else capture.get(cv2.CAP_PROP_ORIENTATION_META) % 180 != 0
    return replace(mirror, aspect=1 / aspect if is_turned else aspect)


def _read_info(capture: cv2.VideoCapture | AvCapture, path: Path, display: Display, track: VideoTrack) -> VideoInfo:
    stored = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if min(stored) < 1:
        raise _undecodable(path)
    width, height = display.size(*stored)
    if width * height > MAX_FRAME_PIXELS:
        raise InputError(
            f"{path} claims frames of {width}x{height}, over the limit of {MAX_FRAME_PIXELS / 1e6:.0f} million pixels: "
            "the file is damaged, or scale it down with `ffmpeg -i IN -vf scale=1920:-2 OUT.mp4`"
        )
    count, fps = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
    if not 0 < fps < _MAX_RATE:
        return VideoInfo(width, height, 0, _UNKNOWN_RATE)
    is_possible = math.isfinite(count) and 0 < count * _FEWEST_BYTES <= path.stat().st_size
    return VideoInfo(width, height, round(count * track.shown) if is_possible else 0, fps)


def _as_rgb8(decoded: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of whatever the decoder hands out (BGR or grey, 8 or 16 bit)."""
    if decoded.dtype == np.uint16:
        decoded = decoded >> 8
    to_rgb = cv2.COLOR_GRAY2RGB if decoded.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(decoded.astype(np.uint8, copy=False), to_rgb), dtype=np.uint8)


class Clock:
    """Container times made strictly increasing, with the first frame at 0: one that is missing or goes back is the
    usual step after the last, as are all after the clock has begun anew, in recordings that were joined to one file."""

    def __init__(self, fps: float) -> None:
        self.times: list[float] = []
        self.repairs = 0
        self._start, self._nominal_step = 0.0, 1.0 / fps

    def next(self, stored: float) -> float:
        """Return the time of the next frame, given what the container says (any float, NaN and negative included)."""
        if not self.times:
            self._start = stored if math.isfinite(stored) else 0.0
            self.times.append(0.0)
        elif _SHORTEST_STEP < stored - self._start - self.times[-1] < math.inf:
            self.times.append(stored - self._start)
        else:
            self.repairs += 1
            steps = [b - a for a, b in itertools.pairwise(self.times[-16:])]
            self.times.append(self.times[-1] + (statistics.median(steps) if steps else self._nominal_step))
        return self.times[-1]
