"""Which images of the source become frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ...formats.video import VideoFrame
from .sharpness import sharpness

_TIME_SLACK = 1e-6
"""Seconds: a frame due exactly at a window's start must not fall into the window before by rounding."""


def sharpest_of_windows(
    pictures: Iterable[VideoFrame],
    rate: float,
    measure: Callable[[NDArray[np.uint8]], float] = sharpness,
) -> Iterator[tuple[VideoFrame, float]]:
    """The sharpest image of every 1/rate seconds, with its sharpness; rate 0 keeps all.

    One pass that holds one image. Windows lie on the source's clock from its first image, so a variable frame
    rate gives an even rate of frames.
    """
    best: tuple[VideoFrame, float] | None = None
    window, start = 0, None
    for picture in pictures:
        start = picture.timestamp if start is None else start
        here = int((picture.timestamp - start + _TIME_SLACK) * rate)
        if best is not None and (rate <= 0 or here != window):
            yield best
            best = None
        window = here
        score = measure(picture.rgb)
        if best is None or score > best[1]:
            best = (picture, score)
    if best is not None:
        yield best
