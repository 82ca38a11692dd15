"""Video files to RGB frames with their times, by OpenCV's FFmpeg."""

from __future__ import annotations

import itertools
import math
import os
import statistics
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# FFmpeg speaks to stderr by itself; both variables are read when OpenCV first opens a video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("OPENCV_VIDEOIO_DEBUG", "0")

import cv2

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.hdr_video import HdrCapture, can_tone_map, hdr_transfer
from msgs_slam.formats.images import IMAGE_SUFFIXES
from msgs_slam.formats.reading import opened

MAX_FRAME_PIXELS = 64_000_000
"""A larger frame is taken for a damaged or hostile header (8K video has 33 million)."""

# The containers of one video each. Left out is what names other files (playlists, scripts, numbered images) or is made
# into images by FFmpeg (text): such a file would show files from elsewhere on this disk, whatever it is called.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts", "mpeg", "mpegvideo", "m4v", "flv", "live_flv", "asf",
    "asf_o", "ogg", "gif", "apng", "h264", "hevc", "av1", "obu", "ivf", "vvc", "vc1", "dv", "mxf", "nut", "wtv", "rm",
    "h263", "mjpeg", "mjpeg_2000", "yuv4mpegpipe", "gxf", "swf", "nsv", "dirac", "cavsvideo", "avs2", "avs3", "r3d",
)  # fmt: skip
_OPTIONS_VARIABLE = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_OPEN_OPTIONS = f"format_whitelist;{','.join(_CONTAINERS)}|protocol_whitelist;file"
_SNIFFED_BYTES = 4096
_UNKNOWN_RATE = 30.0
_SHORTEST_STEP = 1e-6


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
        if next(reader, None) is None:
            raise _undecodable(Path(path))
        return reader.info


class VideoReader(Iterator[VideoFrame]):
    """Iterates over the wanted frames of a video, each a `VideoFrame`.

    `wanted` says by index (a set, a range or a function) which frames to hand out, None for all; the others are
    decoded but not converted to RGB. Rotation stated in the file is applied. Timestamps are those of the container,
    so a variable rate is kept; where they are missing or go back they are repaired to increase strictly.

    After the end `timestamps` holds the time of every decoded frame and `missing_frames` how many frames the header
    promised beyond those: more than a few mean a truncated or damaged file. `repaired_timestamps` counts the repairs.
    `hdr` is "HLG" or "PQ" where the file says so, `tone_mapped` whether its frames are then brought to sRGB.

    Raises InputError at construction as `probe_video` does.
    """

    def __init__(self, path: Path, wanted: Callable[[int], bool] | Container[int] | None = None) -> None:
        self._path = Path(path)
        _require_video_bytes(self._path)
        self._wanted = _as_predicate(wanted)
        self.hdr = hdr_transfer(self._path)
        self.tone_mapped = bool(self.hdr) and can_tone_map()
        self._capture = HdrCapture(self._path, self.hdr) if self.tone_mapped else _open(self._path)
        self.info = _read_info(self._capture, self._path)
        self._clock = _Clock(self.info.fps)
        self.ended = False
        self.unreadable_frames = 0

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

    def __next__(self) -> VideoFrame:
        while self._capture.grab():
            index = len(self._clock.times)
            timestamp = self._clock.next(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
            if not self._wanted(index):
                continue
            decoded, bgr = self._capture.retrieve()
            if decoded and bgr is not None and bgr.size:
                return VideoFrame(index, timestamp, _as_rgb8(bgr))
            self.unreadable_frames += 1
        self.ended = True
        self.close()
        raise StopIteration

    def close(self) -> None:
        """Release the decoder; iterating further ends at once."""
        self._capture.release()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class _Clock:
    """Container times made strictly increasing, with the first frame at 0."""

    def __init__(self, fps: float) -> None:
        self.times: list[float] = []
        self.repairs = 0
        self._nominal_step = 1.0 / fps
        self._last_stored: float | None = None
        self._start = 0.0

    def next(self, stored: float) -> float:
        """The time of the next frame, given what the container says (any float, NaN and negative included)."""
        if not self.times:
            self._start = stored if math.isfinite(stored) else 0.0
            time = 0.0
        else:
            time = self._after(stored)
        self._last_stored = stored if math.isfinite(stored) else self._last_stored
        self.times.append(time)
        return time

    def _after(self, stored: float) -> float:
        previous = self.times[-1]
        if math.isfinite(stored) and stored - self._start > previous + _SHORTEST_STEP:
            return stored - self._start
        self.repairs += 1
        # Where the stored clock was set back once and runs on from there, its steps are still good.
        step = stored - self._last_stored if self._last_stored is not None else 0.0
        return previous + (step if math.isfinite(step) and step > _SHORTEST_STEP else self._typical_step())

    def _typical_step(self) -> float:
        recent = self.times[-16:]
        steps = [b - a for a, b in itertools.pairwise(recent)]
        return statistics.median(steps) if steps else self._nominal_step


def _as_predicate(wanted: Callable[[int], bool] | Container[int] | None) -> Callable[[int], bool]:
    if wanted is None:
        return lambda index: True
    if callable(wanted):
        return wanted
    return wanted.__contains__


def _require_video_bytes(path: Path) -> None:
    """Refuse what is certainly no video before FFmpeg sees it, to say so better than FFmpeg would."""
    if path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{path} is a single image, not a video: give the folder that contains the images")
    with opened(path) as file:
        head = file.read(_SNIFFED_BYTES)
    if b"\0" not in head and _is_text(head):
        raise InputError(f"{path} is a text file, not a video: give a video file or a folder that holds images")


def _is_text(head: bytes) -> bool:
    try:
        # A multi-byte character may be cut at the end of the sample.
        text = head[: len(head) - 4 if len(head) == _SNIFFED_BYTES else None].decode("utf-8")
    except UnicodeDecodeError:
        return False
    return all(c.isprintable() or c.isspace() for c in text)


def _open(path: Path) -> cv2.VideoCapture:
    level, options = cv2.utils.logging.getLogLevel(), os.environ.get(_OPTIONS_VARIABLE)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    os.environ[_OPTIONS_VARIABLE] = _OPEN_OPTIONS  # OpenCV has no other way to hand them to FFmpeg
    try:
        # Without naming the backend, "img_01.jpg" would open as the start of a numbered image series.
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
        del os.environ[_OPTIONS_VARIABLE]
        if options is not None:
            os.environ[_OPTIONS_VARIABLE] = options
    if not capture.isOpened():
        raise _undecodable(path)
    return capture


def _undecodable(path: Path) -> InputError:
    return InputError(
        f"no image can be decoded from {path}: it contains no video stream (audio only?), is damaged, or was not "
        "copied completely: play it in a video player, and if it plays convert it with `ffmpeg -i IN -c:v libx264 "
        "OUT.mp4`"
    )


def _read_info(capture: cv2.VideoCapture | HdrCapture, path: Path) -> VideoInfo:
    width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
    height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if width < 1 or height < 1:
        raise _undecodable(path)
    if width * height > MAX_FRAME_PIXELS:
        raise InputError(
            f"{path} claims frames of {width}x{height}, over the limit of {MAX_FRAME_PIXELS / 1e6:.0f} million pixels: "
            "the file is damaged, or scale it down with `ffmpeg -i IN -vf scale=1920:-2 OUT.mp4`"
        )
    count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    fps = capture.get(cv2.CAP_PROP_FPS)
    claimed = int(count) if math.isfinite(count) and count > 0 else 0
    rate = fps if math.isfinite(fps) and fps > 0 else _UNKNOWN_RATE
    return VideoInfo(width, height, claimed, rate)


def _as_rgb8(decoded: NDArray) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of whatever the decoder hands out (BGR or grey, 8 or 16 bit)."""
    if decoded.dtype == np.uint16:
        decoded = decoded >> 8
    to_rgb = cv2.COLOR_GRAY2RGB if decoded.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(decoded.astype(np.uint8, copy=False), to_rgb), dtype=np.uint8)
