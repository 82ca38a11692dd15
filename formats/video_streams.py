"""Finding interlaced streams, and decoding by PyAV: what OpenCV does not do for a video.

PyAV reads HDR (HLG, PQ), which OpenCV's decoder cuts to 8 flat bits, codecs that OpenCV does not have, tracks behind
the first, and interlaced video: each frame holds two fields (half pictures) of different times, or is one. OpenCV's
FFmpeg (from OpenCV 4.13 on) cannot convert such frames, and does not say so: it hands out whatever its buffer held
before, black, the last frame, or a picture of another video."""

import contextlib
import functools
import itertools
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .colours import RGB_FROM_2020, srgb_of
from .errors import InputError, install_extra
from .video_head import TRANSFERS

# The containers of one video each. Left out is what names other files (playlists, scripts, numbered images) or is made
# into images by FFmpeg (text): such a file would show files from elsewhere on this disk, whatever it is called.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "mpegts", "mpeg", "mpegvideo", "m4v", "flv", "live_flv", "asf",
    "asf_o", "ogg", "gif", "apng", "h264", "hevc", "av1", "obu", "ivf", "vvc", "vc1", "dv", "mxf", "nut", "wtv", "rm",
    "h263", "mjpeg", "mjpeg_2000", "yuv4mpegpipe", "gxf", "swf", "nsv", "dirac", "cavsvideo", "avs2", "avs3", "r3d",
)  # fmt: skip
OPEN_OPTIONS = {"format_whitelist": ",".join(_CONTAINERS), "protocol_whitelist": "file"}

_PROGRESSIVE = 1
"""AV_FIELD_PROGRESSIVE; 0 is unknown, all above are interlaced."""
_TIMEOUT = 120.0
_LISTEN = (
    "import sys, cv2\n"
    "capture = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG)\n"
    "for _ in range(int(sys.argv[2])): capture.read()"
)

_KNEE = 0.75
"""Up to this part of diffuse white light stays as it is; all that is brighter shares the rest."""


class AvCapture:
    """Reader by PyAV with the part of OpenCV's VideoCapture that is used here: for HDR (`transfer` "HLG" or "PQ"),
    whose frames are tone-mapped; for interlaced video, which is deinterlaced to as many frames as it has; for a video
    track that is not the first; and for codecs that OpenCV cannot decode. What cannot be opened has no frame."""

    def __init__(self, path: Path, transfer: str = "", interlaced: bool = False, track: int = 0) -> None:
        import av

        self._transfer, self._turns = transfer, True
        self.codec = ""
        self._frame: Any = None
        self._stream: Any = None
        self._frames: Iterator[Any] = iter(())
        try:
            self._container = av.open(str(path), options=OPEN_OPTIONS)
            self._stream = self._container.streams.video[track]
            self._stream.thread_type = "AUTO"
            self.codec = self._stream.codec_context.name
        except (av.FFmpegError, OSError, ValueError, IndexError):
            return
        self._frames = _decoded(self._container, self._stream, interlaced)

    def isOpened(self) -> bool:
        """Return whether there is a video stream."""
        return self._stream is not None

    def get(self, what: int) -> float:
        """Return the properties that are asked for, of the frame grabbed last; 0 for others."""
        frame, stream = self._frame, self._stream
        turn = frame.rotation % 360
        size = (frame.height, frame.width) if self._turns and turn % 180 else (frame.width, frame.height)
        shape = stream.sample_aspect_ratio or 0
        values = {
            cv2.CAP_PROP_FRAME_WIDTH: size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: size[1],
            cv2.CAP_PROP_FRAME_COUNT: stream.frames,
            cv2.CAP_PROP_FPS: stream.guessed_rate or 0,
            cv2.CAP_PROP_POS_MSEC: float("nan") if frame.time is None else 1000 * frame.time,
            cv2.CAP_PROP_ORIENTATION_META: turn,
            cv2.CAP_PROP_SAR_NUM: shape and shape.numerator,
            cv2.CAP_PROP_SAR_DEN: shape and shape.denominator,
        }
        return float(values.get(what, 0))

    def set(self, what: int, value: float) -> bool:
        """Leave the frames lying as they are stored, by CAP_PROP_ORIENTATION_AUTO; False for other properties."""
        if what == cv2.CAP_PROP_ORIENTATION_AUTO:
            self._turns = bool(value)
        return what == cv2.CAP_PROP_ORIENTATION_AUTO

    def grab(self) -> bool:
        """Go to the next frame; False at the end."""
        following = next(self._frames, None)
        self._frame = following or self._frame
        return following is not None

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        """Return the frame as OpenCV would give it: (H, W, 3) uint8 BGR, upright."""
        frame = self._frame
        if self._transfer:
            bgr = tone_mapped(frame.to_ndarray(format="rgb48le"), self._transfer)[..., ::-1]
        else:
            bgr = frame.to_ndarray(format="bgr24")
        return True, np.ascontiguousarray(np.rot90(bgr, frame.rotation // 90 if self._turns else 0))

    def release(self) -> None:
        """Close the video file."""
        if self._stream is not None:
            self._frames = iter(())
            self._container.close()


def _decoded(container: Any, stream: Any, interlaced: bool) -> Iterator[Any]:
    """Frames in the order of time; packets that do not decode are passed over, as OpenCV does."""
    import av

    graph = _deinterlacer(stream) if interlaced else None
    packets, is_open = container.demux(stream), True
    while is_open:
        try:
            packet = next(packets, None)
            is_open = packet is not None
            frames = packet.decode() if packet is not None else _rest(stream)
        except av.FFmpegError:  # raised by `next` it is the last one: the file is truncated, what came before is good
            continue
        yield from frames if graph is None else _through(graph, frames if is_open else [*frames, None])


def _rest(stream: Any) -> list[Any]:
    """What the decoder still holds, where no end of the file has told it to hand that out."""
    import av

    try:
        return list(stream.codec_context.decode(None))
    except av.FFmpegError:
        return []


def _deinterlacer(stream: Any) -> Any:
    """A graph that makes one frame of each; frames that are not marked as interlaced stay as they are."""
    import av

    graph = av.filter.Graph()
    nodes = (
        graph.add_buffer(template=stream, time_base=stream.time_base),
        graph.add("bwdif", "mode=send_frame:parity=auto:deint=interlaced"),
    )
    graph.link_nodes(*nodes, graph.add("buffersink")).configure()
    return graph


def _through(graph: Any, frames: list[Any]) -> Iterator[Any]:
    import av

    for frame in frames:
        graph.push(frame)
        with contextlib.suppress(av.BlockingIOError, av.EOFError):
            while True:
                yield graph.pull()


def tone_mapped(rgb: NDArray[np.uint16], transfer: str) -> NDArray[np.uint8]:
    """Convert to (H, W, 3) sRGB BT.2020 images with that transfer function, full range.

    Diffuse white (ITU-R BT.2408: 203 cd/m2 in PQ, 75 % in HLG, whose light is taken as the scene's) stays near white;
    above `_KNEE` the largest channel bends towards 1 and takes the others along, so that hues stay.
    """
    light = cv2.transform(_light(transfer)[rgb], RGB_FROM_2020.astype(np.float32)).clip(0)
    largest = light.max(axis=2, keepdims=True)
    over = (largest - _KNEE).clip(0) / (1 - _KNEE)
    bent = np.minimum(largest, _KNEE) + (1 - _KNEE) * over / (1 + over)
    light *= bent / np.maximum(largest, np.float32(1e-6))
    return srgb_of(light)


@functools.cache
def _light(transfer: str) -> NDArray[np.float32]:
    """(65536,) light of a channel's values, 1 = diffuse white (ITU-R BT.2100)."""
    signal = np.arange(65536) / 65535
    if transfer == "HLG":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        return (scene / ((np.exp((0.75 - c) / a) + b) / 12)).astype(np.float32)
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = signal ** (1 / m2)
    return (10000 / 203 * ((root - c1).clip(0) / (c2 - c3 * root)) ** (1 / m1)).astype(np.float32)


def has_pyav() -> bool:
    """Return whether PyAV is there (the extra "hdr")."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


@dataclass(frozen=True)
class StreamFacts:
    """Whether FFmpeg takes a stream, or one of its first frames, for interlaced; and "HLG" or "PQ" where the stream
    itself says that it is HDR."""

    is_interlaced: bool = False
    transfer: str = ""


def read_facts(path: Path, frames: int, track: int = 0) -> StreamFacts:
    """Read the facts of a video track from its first `frames`, by PyAV; without it, and then nothing of HDR, by what
    FFmpeg complains of. What cannot be read has none."""
    return _by_pyav(path, frames, track) if has_pyav() else StreamFacts(_by_listening(path, frames))


def _by_pyav(path: Path, frames: int, track: int) -> StreamFacts:
    import av

    try:
        with av.open(str(path), options=OPEN_OPTIONS) as container:
            if track >= len(container.streams.video):
                return StreamFacts()
            stream = container.streams.video[track]
            stream.thread_type = "AUTO"
            transfer = TRANSFERS.get(int(stream.codec_context.color_trc), "")
            if stream.codec_context.field_order > _PROGRESSIVE:
                return StreamFacts(True, transfer)
            first = itertools.islice(container.decode(stream), frames)
            return StreamFacts(any(frame.interlaced_frame for frame in first), transfer)
    except (av.FFmpegError, OSError, ValueError):
        return StreamFacts()


def _by_listening(path: Path, frames: int) -> bool:
    """OpenCV asks FFmpeg for its errors once, when it is first used: only another process can hear them."""
    said = {"OPENCV_FFMPEG_LOGLEVEL": "16", "OPENCV_FFMPEG_CAPTURE_OPTIONS": as_opencv_writes_them()}
    command = [sys.executable, "-c", _LISTEN, str(path.resolve()), str(frames)]
    try:
        done = subprocess.run(command, env=os.environ | said, capture_output=True, timeout=_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return b"interlaced" in done.stdout + done.stderr


def unreadable(path: Path, codec: str, first: int = 0) -> InputError:
    """Say that a video is interlaced from frame `first` on and how to convert it; `codec` by its four letters or
    FFmpeg's name. HEVC stores each field as a picture of its own, which have to be joined first."""
    file = shlex.quote(str(path))
    if codec.lower() in ("hevc", "hev1", "hvc1"):
        return InputError(
            f"{path} is interlaced video whose fields are stored as separate images: convert it with "
            f"`ffmpeg -i {file} -vf weave,bwdif OUT.mp4`"
        )
    if has_pyav():
        return InputError(
            f"{path} is interlaced from about frame {first} on, and progressive before: convert it with "
            f"`ffmpeg -i {file} -vf yadif OUT.mp4`"
        )
    return InputError(
        f"{path} is interlaced video (as from camcorders and television), which OpenCV does not decode: install PyAV "
        f"with `{install_extra('hdr')}`, or convert it with `ffmpeg -i {file} -vf yadif OUT.mp4`"
    )


def as_opencv_writes_them() -> str:
    """Return OPEN_OPTIONS as the variable OPENCV_FFMPEG_CAPTURE_OPTIONS has them."""
    return "|".join(f"{name};{value}" for name, value in OPEN_OPTIONS.items())
