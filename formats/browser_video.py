"""Videos that a browser plays: H.264 where PyAV is installed, else VP9 by OpenCV's own FFmpeg."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import InputError
from .video_writer import write_video

H264, VP9, MPEG4 = "H.264", "VP9", "MPEG-4 part 2"
PLAYED = (H264, VP9)
"""By browsers."""
_QUALITY = "18"
"""x264's constant rate factor: hardly distinguishable from the images themselves."""


def write_browser_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, codec: str = "") -> str:
    """Encode RGB frames (H, W, 3) of one size into an .mp4, atomically; returns the name of its codec: `codec`, or the
    best that is here. An odd row or column at the end is left out.

    Raises InputError where there is no frame.
    """
    codec = codec or best_codec(path.parent)
    if codec == H264:
        _write_h264(path, frames, fps)
    else:
        write_video(path, frames, fps, "vp09" if codec == VP9 else "mp4v")
    return codec


def best_codec(folder: Path) -> str:
    """The first of H.264, VP9 and MPEG-4 part 2 that can be written here; tried in `folder`."""
    if _has_x264():
        return H264
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / ".codec.mp4") as trial:
        writer = cv2.VideoWriter(str(trial), cv2.VideoWriter.fourcc(*"vp09"), 10.0, (64, 64))
        found = writer.isOpened()
        writer.release()
        trial.touch()
    (folder / ".codec.mp4").unlink(missing_ok=True)
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
