"""Sharpness of an image."""

from collections.abc import Callable, Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.video import VideoFrame

_TIME_SLACK = 1e-6
"""Seconds: a frame due exactly at a window's start must not fall into the window before by rounding."""

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


def sharpest_of_windows(
    pictures: Iterable[VideoFrame], rate: float, measure: Callable[[NDArray[np.uint8]], float] = sharpness
) -> Iterator[tuple[VideoFrame, float]]:
    """The sharpest image of every 1/rate seconds, with its sharpness; rate 0 keeps all.

    One pass that holds one image. Windows lie on the source's clock from its first image, so a variable frame
    rate gives an even rate of frames.
    """
    if rate <= 0:
        yield from ((picture, measure(picture.rgb)) for picture in pictures)
        return
    best: tuple[VideoFrame, float] | None = None
    window, start = 0, None
    for picture in pictures:
        start = picture.timestamp if start is None else start
        here = int((picture.timestamp - start + _TIME_SLACK) * rate)
        if best is not None and here != window:
            yield best
            best = None
        window = here
        score = measure(picture.rgb)
        if best is None or score > best[1]:
            best = (picture, score)
    if best is not None:
        yield best
