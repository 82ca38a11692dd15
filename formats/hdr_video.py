"""Video by PyAV: HDR (HLG, PQ) in the colours of ordinary images, where OpenCV's decoder cuts it to 8 flat bits, and
other video that OpenCV cannot decode."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .containers import OPEN_OPTIONS
from .spherical import read_moov

_TRANSFERS = {16: "PQ", 18: "HLG"}  # ITU-T H.273, table 3
_KNEE = 0.75
"""Up to this part of diffuse white light stays as it is; all that is brighter shares the rest."""
_709_FROM_2020 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
"""Linear RGB, ITU-R BT.2087."""
_FINE = 1 << 14


def hdr_transfer(path: Path) -> str:
    """ "HLG" or "PQ" where an MP4 or MOV says so in its colr box; "" for all else."""
    moov = read_moov(path)
    place = moov.find(b"colrnclx")
    return _TRANSFERS.get(int.from_bytes(moov[place + 10 : place + 12], "big"), "") if place >= 0 else ""


class AvCapture:
    """Reader by PyAV with the part of OpenCV's VideoCapture that is used here: for HDR (`transfer` as `hdr_transfer`
    says), whose frames are tone-mapped; for interlaced video, which is deinterlaced to as many frames as it has; and
    for codecs that OpenCV cannot decode. What cannot be opened has no frame."""

    def __init__(self, path: Path, transfer: str = "", interlaced: bool = False) -> None:
        import av

        self._transfer, self._turns = transfer, True
        self.codec = ""
        self._frame: Any = None
        self._stream: Any = None
        self._frames: Iterator[Any] = iter(())
        try:
            self._container = av.open(str(path), options=OPEN_OPTIONS)
            self._stream = self._container.streams.video[0]
            self._stream.thread_type = "AUTO"
            self.codec = self._stream.codec_context.name
        except (av.FFmpegError, OSError, ValueError, IndexError):
            return
        self._frames = _decoded(self._container, self._stream, interlaced)

    def isOpened(self) -> bool:
        """Whether there is a video stream."""
        return self._stream is not None

    def get(self, what: int) -> float:
        """The properties that are asked for, of the frame grabbed last; 0 for others."""
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
        """The frame as OpenCV would give it: (H, W, 3) uint8 BGR, upright."""
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
    """(H, W, 3) sRGB of BT.2020 images with that transfer function, full range.

    Diffuse white (ITU-R BT.2408: 203 cd/m2 in PQ, 75 % in HLG, whose light is taken as the scene's) stays near white;
    above `_KNEE` the largest channel bends towards 1 and takes the others along, so that hues stay.
    """
    light = cv2.transform(_light(transfer)[rgb], _709_FROM_2020.astype(np.float32)).clip(0)
    largest = light.max(axis=2, keepdims=True)
    over = (largest - _KNEE).clip(0) / (1 - _KNEE)
    bent = np.minimum(largest, _KNEE) + (1 - _KNEE) * over / (1 + over)
    light *= bent / np.maximum(largest, np.float32(1e-6))
    return _srgb()[(light * (_FINE - 1) + 0.5).astype(np.uint16).clip(0, _FINE - 1)]


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


@functools.cache
def _srgb() -> NDArray[np.uint8]:
    """(_FINE,) sRGB's byte of light 0..1 (IEC 61966-2-1)."""
    light = np.arange(_FINE) / (_FINE - 1)
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(curved * 255).astype(np.uint8)
