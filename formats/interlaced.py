"""Interlaced video: each frame holds two fields (half pictures) of different times, or is one field.

OpenCV's FFmpeg (from OpenCV 4.13 on) cannot convert such frames, and does not say so: it hands out whatever its buffer
held before, black, the last frame, or a picture of another video. PyAV reads them where it is installed.
"""

from __future__ import annotations

import itertools
import os
import shlex
import subprocess
import sys
from pathlib import Path

from .containers import OPEN_OPTIONS, as_opencv_writes_them
from .errors import InputError

_PROGRESSIVE = 1
"""AV_FIELD_PROGRESSIVE; 0 is unknown, all above are interlaced."""
_TIMEOUT = 120.0
_LISTEN = (
    "import sys, cv2\n"
    "capture = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG)\n"
    "for _ in range(int(sys.argv[2])): capture.read()"
)


def has_pyav() -> bool:
    """Whether PyAV is there (the extra "hdr")."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


def is_interlaced(path: Path, frames: int) -> bool:
    """Whether FFmpeg takes the stream, or one of its first `frames`, for interlaced; False for what it cannot read."""
    return _by_pyav(path, frames) if has_pyav() else _by_listening(path, frames)


def _by_pyav(path: Path, frames: int) -> bool:
    import av

    try:
        with av.open(str(path), options=OPEN_OPTIONS) as container:
            if not container.streams.video:
                return False
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if stream.codec_context.field_order > _PROGRESSIVE:
                return True
            return any(frame.interlaced_frame for frame in itertools.islice(container.decode(stream), frames))
    except (av.FFmpegError, OSError, ValueError):
        return False


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
        f"with `pip install 'msgs-slam[hdr]'`, or convert it with `ffmpeg -i {file} -vf yadif OUT.mp4`"
    )
