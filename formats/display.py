"""Frames of a video as they are to be shown: mirrored where the file says so, and with square pixels."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from .spherical import read_moov

_SQUARE = 0.002
"""Sides that differ by less come from a size that was rounded to whole pixels."""
_LONGEST_PIXEL = 5.0
"""Length of a pixel's sides to each other; what is beyond is a damaged number."""


@dataclass(frozen=True)
class Display:
    """Steps that are left to do after the decoder's turn, in this order: swap the axes, mirror left to right (-1) and
    top to bottom, and lengthen pixels: `aspect` is their width by their height as they are then, 1 for squares."""

    swaps: bool = False
    mirror: tuple[int, int] = (1, 1)
    aspect: float = 1.0

    @property
    def is_mirrored(self) -> bool:
        """Whether the file asks for a mirrored picture, which no turn gives."""
        return self.swaps or self.mirror != (1, 1)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height in which a decoded frame of that size is shown; none becomes less."""
        width, height = (height, width) if self.swaps else (width, height)
        if self.aspect >= 1:
            return round(width * self.aspect), height
        return width, round(height / self.aspect)

    def shown(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, ...) in the size that `size` says."""
        size = self.size(image.shape[1], image.shape[0])
        image = np.swapaxes(image, 0, 1) if self.swaps else image
        image = np.ascontiguousarray(image[:: self.mirror[1], :: self.mirror[0]])
        if size == (image.shape[1], image.shape[0]):
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def read_mirror(path: Path) -> Display:
    """The Display of an MP4 or MOV whose track header (ISO/IEC 14496-12, 8.3.2) mirrors the picture; for all other
    files, and where it only turns, which decoders do, one that leaves all as it is."""
    for track in read_moov(path).split(b"trak")[1:]:
        head = track.find(b"tkhd")
        if head < 0 or b"vide" not in track:
            continue
        start = head + 4 + (52 if track[head + 4 : head + 5] == b"\1" else 40)
        if len(track) < start + 20:
            continue
        a, b, _, c, d = struct.unpack(">5i", track[start : start + 20])  # x' = a x + c y, y' = b x + d y
        if a * d - b * c < 0:
            swaps = abs(a) < abs(b)
            across, down = (c, b) if swaps else (a, d)
            return Display(swaps, (1 if across > 0 else -1, 1 if down > 0 else -1))
        return Display()
    return Display()


def pixel_aspect(wide: float, high: float) -> float:
    """Width by height of a pixel; 1 where it is not said (0), damaged, or only rounding away from a square."""
    aspect = wide / high if wide > 0 and high > 0 else 1.0
    is_square = abs(aspect - 1) < _SQUARE or not 1 / _LONGEST_PIXEL <= aspect <= _LONGEST_PIXEL
    return 1.0 if is_square else aspect
