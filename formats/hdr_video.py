"""HDR video (HLG, PQ) brought to the colours of ordinary images: OpenCV's decoder cuts it to 8 flat bits."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.spherical import read_moov

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


def can_tone_map() -> bool:
    """Whether PyAV is there (the extra "hdr")."""
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


class HdrCapture:
    """Reader of HDR videos with the part of OpenCV's VideoCapture that is used here; frames are tone-mapped."""

    def __init__(self, path: Path, transfer: str) -> None:
        import av

        self._failure = av.FFmpegError
        self._transfer = transfer
        self._container = av.open(str(path), format="mov", options={"protocol_whitelist": "file"})
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._frames = self._container.decode(self._stream)
        self._waiting = self._decoded()
        self._frame: Any = self._waiting

    def _decoded(self) -> Any:
        try:
            return next(self._frames, None)
        except self._failure:  # a truncated file: what came before it is good
            return None

    def isOpened(self) -> bool:
        """Whether there is a frame at all."""
        return self._frame is not None

    def get(self, what: int) -> float:
        """The properties that are asked for; 0 for others."""
        frame = self._frame
        size = (frame.width, frame.height) if frame.rotation % 180 == 0 else (frame.height, frame.width)
        values = {
            cv2.CAP_PROP_FRAME_WIDTH: size[0],
            cv2.CAP_PROP_FRAME_HEIGHT: size[1],
            cv2.CAP_PROP_FRAME_COUNT: self._stream.frames,
            cv2.CAP_PROP_FPS: self._stream.average_rate or 0,
            cv2.CAP_PROP_POS_MSEC: float("nan") if frame.time is None else 1000 * frame.time,
        }
        return float(values.get(what, 0))

    def grab(self) -> bool:
        """Go to the next frame; False at the end."""
        following, self._waiting = self._waiting or self._decoded(), None
        self._frame = following or self._frame
        return following is not None

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        """The frame as OpenCV would give it: (H, W, 3) uint8 BGR, upright."""
        rgb = tone_mapped(self._frame.to_ndarray(format="rgb48le"), self._transfer)
        return True, np.ascontiguousarray(np.rot90(rgb, self._frame.rotation // 90)[..., ::-1])

    def release(self) -> None:
        """Close the video file."""
        self._container.close()


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
