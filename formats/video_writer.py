"""Writing videos: with what OpenCV brings along, and for browsers by H.264 where PyAV is installed."""

import errno
import os
import tempfile
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path, free_bytes, is_disk_full
from .errors import DiskFullError, InputError
from .reading import require_unicode

H264, VP9, MPEG4 = "H.264", "VP9", "MPEG-4 part 2"
PLAYED = (H264, VP9)
"""By browsers."""
_QUALITY = "18"
"""x264's constant rate factor: hardly distinguishable from the images themselves."""

CODECS = {".mp4": "mp4v", ".avi": "FFV1", ".mkv": "FFV1"}
"""By the file's ending: MPEG-4 plays everywhere, FFV1 loses nothing."""


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
    with atomic_path(path) as temporary:
        writer: cv2.VideoWriter | None = None
        size, written = (0, 0), 0
        try:
            for frame in frames:
                even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
                if writer is None:
                    size = (even.shape[1], even.shape[0])
                    writer = _open_writer(temporary, codec, fps, size)
                if (even.shape[1], even.shape[0]) != size:
                    raise ValueError(f"write_video: a frame of {even.shape[1]}x{even.shape[0]} among those of {size}")
                written += 1
                writer.write(cv2.cvtColor(np.ascontiguousarray(even), cv2.COLOR_RGB2BGR))
        finally:
            if writer is not None:
                writer.release()
        if writer is None:
            raise InputError(f"{path}: there is no frame to write")
        _require_all(temporary, path, written)
    return path


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


def _open_writer(path: Path, codec: str, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
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
    if codec == H264:
        _write_h264(path, frames, fps)
    else:
        write_video(path, frames, fps, "vp09" if codec == VP9 else "mp4v")
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


def _write_h264(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    import av

    rest: Iterator[NDArray[np.uint8]] = iter(frames)
    if (first := next(rest, None)) is None:
        raise InputError(f"{path}: there is no frame to write")
    height, width = (side // 2 * 2 for side in first.shape[:2])
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": _QUALITY}
        for frame in chain([first], rest):
            even = np.ascontiguousarray(frame[:height, :width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        container.mux(stream.encode(None))
