"""Finding interlaced streams, and decoding by PyAV: what OpenCV does not do for a video; and writing videos, with what
OpenCV brings along, and for browsers by H.264 where PyAV is installed.

PyAV reads HDR (HLG, PQ), which OpenCV's decoder cuts to 8 flat bits, codecs that OpenCV does not have, tracks behind
the first, and interlaced video: each frame holds two fields (half pictures) of different times, or is one. OpenCV's
FFmpeg (from OpenCV 4.13 on) cannot convert such frames, and does not say so: it hands out whatever its buffer held
before, black, the last frame, or a picture of another video."""

import contextlib
import errno
import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path, free_bytes, is_disk_full
from .errors import DiskFullError, InputError, install_extra, shell_word
from .image_tags import tone_mapped
from .reading import require_unicode
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


H264, VP9, MPEG4 = "H.264", "VP9", "MPEG-4 part 2"
PLAYED = (H264, VP9)
"""By browsers."""
_QUALITY = "18"
"""x264's constant rate factor: hardly distinguishable from the images themselves."""

CODECS = {".mp4": "mp4v", ".avi": "FFV1", ".mkv": "FFV1"}
"""By the file's ending: MPEG-4 plays everywhere, FFV1 loses nothing."""


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


def has_pyav() -> bool:
    """Return whether PyAV is there (the extra "hdr")."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


def read_facts(path: Path, frames: int, track: int = 0) -> tuple[bool, str]:
    """Return whether FFmpeg takes a video track, or one of its first `frames`, for interlaced; and "HLG" or "PQ" where
    the stream itself says that it is HDR. Without PyAV nothing of HDR, and the first by what FFmpeg complains of. What
    cannot be read is (False, "")."""
    if not has_pyav():
        return _interlaced_by_ffmpeg_log(path, frames), ""
    import av

    try:
        with av.open(str(path), options=OPEN_OPTIONS) as container:
            stream = container.streams.video[track]
            stream.thread_type = "AUTO"
            transfer = TRANSFERS.get(int(stream.codec_context.color_trc), "")
            if stream.codec_context.field_order > _PROGRESSIVE:
                return True, transfer
            first = itertools.islice(container.decode(stream), frames)
            return any(frame.interlaced_frame for frame in first), transfer
    except (av.FFmpegError, OSError, ValueError, IndexError):
        return False, ""


def _interlaced_by_ffmpeg_log(path: Path, frames: int) -> bool:
    """OpenCV asks FFmpeg for its errors once, when it is first used: only another process can hear them."""
    said = {"OPENCV_FFMPEG_LOGLEVEL": "16", "OPENCV_FFMPEG_CAPTURE_OPTIONS": opencv_capture_options()}
    command = [sys.executable, "-c", _LISTEN, str(path.resolve()), str(frames)]
    try:
        done = subprocess.run(command, env=os.environ | said, capture_output=True, timeout=_TIMEOUT, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return b"interlaced" in done.stdout + done.stderr


def interlaced_error(path: Path, codec: str, first: int = 0) -> InputError:
    """Say that a video is interlaced from frame `first` on and how to convert it; `codec` by its four letters or
    FFmpeg's name. HEVC stores each field as a picture of its own, which have to be joined first."""
    install, filters = "", "yadif"
    if codec.lower() in ("hevc", "hev1", "hvc1"):
        what, filters = f"{path} is interlaced video whose fields are stored as separate images", "weave,bwdif"
    elif has_pyav():
        what = f"{path} is interlaced from about frame {first} on, and progressive before"
    else:
        what = f"{path} is interlaced video (as from camcorders and television), which OpenCV does not decode"
        install = f"install PyAV with `{install_extra('hdr')}`, or "
    fix = f"{install}convert it with `ffmpeg -i {shell_word(str(path))} -vf {filters} OUT.mp4`"
    return InputError(f"{what}: {fix}")


def opencv_capture_options() -> str:
    """Return OPEN_OPTIONS as the variable OPENCV_FFMPEG_CAPTURE_OPTIONS has them."""
    return "|".join(f"{name};{value}" for name, value in OPEN_OPTIONS.items())


# writing -------------------------------------------------------------------------------------------------------------


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, codec: str | None = None) -> Path:
    """Encode RGB frames (H, W, 3) of one size, atomically: MPEG-4 for .mp4, lossless FFV1 for .avi and .mkv, or by a
    codec of those four letters.

    An odd row or column at the end is left out: MPEG-4 has none. Returns `path`. Raises InputError for another ending,
    no frame at all, or a codec that this OpenCV does not have; ValueError for frames of different sizes.
    """
    codec = codec or CODECS.get(path.suffix.lower())
    if codec is None:
        raise InputError(f"{path}: cannot tell the video format; give a file name that ends in {' or '.join(CODECS)}")
    require_unicode(path)  # OpenCV ends the whole process
    pictures = _even(path, frames)
    first = next(pictures)
    with atomic_path(path) as temporary:
        writer = _open_writer(temporary, codec, fps, first.shape[1::-1])
        written = 0
        try:
            for frame in chain([first], pictures):
                writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
                written += 1
        finally:
            writer.release()
        _require_all(temporary, path, written)
    return path


def _even(path: Path, frames: Iterable[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """The frames without an odd row or column at the end."""
    shape: tuple[int, ...] | None = None
    for frame in frames:
        even = np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
        shape = shape or even.shape
        if even.shape != shape:
            raise ValueError(f"write_video: a frame of {even.shape} among those of {shape}")
        yield even
    if shape is None:
        raise InputError(f"{path}: there is no frame to write")


def _require_all(temporary: Path, path: Path, written: int) -> None:
    """OpenCV says nothing of a disk that has become full: look whether every frame can be read again."""
    capture = cv2.VideoCapture(str(temporary))
    found = 0
    while capture.grab():
        found += 1
    capture.release()
    if found != written:
        raise DiskFullError(
            f"{path}: only {found} of {written} frames could be written, {free_bytes(path.parent) / 1e6:.0f} MB are "
            "free: free some space, or choose another place"
        )


def _open_writer(path: Path, codec: str, fps: float, size: Sequence[int]) -> cv2.VideoWriter:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
    if not writer.isOpened():
        if is_disk_full(OSError(), path.parent):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise InputError(f"{path}: this OpenCV cannot write {codec} video; install opencv-python-headless from PyPI")
    return writer


def write_browser_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, codec: str = "") -> str:
    """Encode RGB frames (H, W, 3) of one size into an .mp4, atomically; returns the name of its codec: `codec`, or the
    best that is here. An odd row or column at the end is left out.

    Raises InputError where there is no frame.
    """
    codec = codec or best_codec()
    if codec != H264:
        write_video(path, frames, fps, "vp09" if codec == VP9 else "mp4v")
        return codec
    import av

    pictures = _even(path, frames)
    first = next(pictures)
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": _QUALITY}
        for frame in chain([first], pictures):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))
    return codec


def best_codec() -> str:
    """Return the first of H.264, VP9 and MPEG-4 part 2 that can be written here."""
    if _has_x264():
        return H264
    with tempfile.TemporaryDirectory() as folder:
        writer = cv2.VideoWriter(str(Path(folder) / "trial.mp4"), cv2.VideoWriter.fourcc(*"vp09"), 10.0, (64, 64))
        found = writer.isOpened()
        writer.release()
    return VP9 if found else MPEG4


def _has_x264() -> bool:
    try:
        import av

        return av.codec.Codec("libx264", "w").name == "libx264"
    except (ImportError, ValueError):  # an FFmpeg without it says UnknownCodecError, which is a ValueError
        return False
