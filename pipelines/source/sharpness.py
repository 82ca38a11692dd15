"""Sharpness of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_MEASURED_SIDE = 480
"""Sharpness is measured at this long side: sensor noise is averaged away, and all sources are alike."""


def sharpness(rgb: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of the reduced grey image (H, W, 3) uint8; larger is sharper."""
    gray = cv2.cvtColor(reduce_image(rgb, _MEASURED_SIDE), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def reduced_size(width: int, height: int, max_side: int) -> tuple[int, int]:
    """(width, height) with the long side at most `max_side`, the shape kept; 0 = no limit."""
    longest = max(width, height)
    if max_side <= 0 or longest <= max_side:
        return width, height
    return max(1, round(width * max_side / longest)), max(1, round(height * max_side / longest))


def at_most_wide(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """The image (H, W, 3) at most `width` pixels wide, averaged; itself when it is narrow enough."""
    if image.shape[1] <= width:
        return image
    size = (width, round(width * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def reduce_image(image: NDArray[np.uint8], max_side: int) -> NDArray[np.uint8]:
    """The image with its long side at most `max_side` pixels, averaged; itself when it is small enough."""
    height, width = image.shape[:2]
    size = reduced_size(width, height, max_side)
    if size == (width, height):
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
