"""Picking images from a source: the sharpest of a while, and more where what they show changes too fast."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.video import VideoFrame

_TIME_SLACK = 1e-6
"""Seconds: a frame due exactly at a window's start must not fall into the window before by rounding."""

_MEASURED_SIDE = 480
"""Sharpness is measured at this long side: sensor noise is averaged away, and all sources are alike."""
_SIDE, _CORNERS, _APART_PX = 240, 60, 8.0
_FEWEST = 8
"""Corners by which a step is measured."""
_TOO_FAR, _FAR, _AROUND = 1 / 8, 1 / 16, 2
"""Of the longer side, in the median of a step and as many before and behind it: beyond the first, picked images hardly
overlap, and so it is before and behind where it is beyond the second. At ten images a second the largest of six videos
and a data set is 0.04 to 0.11, in a quick turn; that of six time-lapses 0.13 to 0.28."""


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


class Motion:
    """Motion in a source from one picked image to the next, by corners followed through those between;
    and which images are wanted beside the picked ones because that is too far."""

    def __init__(self) -> None:
        self._seen: list[int] = []
        self._picks: list[int] = []
        self._steps: list[float] = []
        self._grays: dict[int, NDArray[np.uint8]] = {}

    def watch(self, pictures: Iterable[VideoFrame]) -> Iterator[VideoFrame]:
        """Hand on the images of a source, each of which `pick` may name afterwards."""
        for picture in pictures:
            gray = cv2.cvtColor(reduce_image(picture.rgb, _SIDE), cv2.COLOR_RGB2GRAY)
            self._grays[picture.source_index] = np.asarray(gray, np.uint8)
            self._seen.append(picture.source_index)
            yield picture

    def pick(self, number: int) -> None:
        """Measure the step from the last picked image to this one, of a larger number."""
        if self._picks:
            self._steps.append(_moved([gray for n, gray in self._grays.items() if n <= number]))
        self._grays = {n: gray for n, gray in self._grays.items() if n >= number}
        self._picks.append(number)

    def wanted(self) -> list[int]:
        """Return the picked numbers; and where the steps between them are too large so many of those seen between that
        the steps become small, before the first and behind the last as at the step beside it."""
        first = np.searchsorted(self._seen, self._picks)
        strides = _strides(self._steps, np.diff(first).tolist())
        if not any(strides):
            return self._picks
        kept = set(self._picks)
        before = (np.searchsorted(self._picks, self._seen, side="right") - 1).clip(0)
        stride = np.array(strides)[before.clip(0, len(strides) - 1)]
        behind = np.arange(len(self._seen)) - first[before]
        more = (stride > 0) & (behind % np.maximum(stride, 1) == 0)
        return [number for number, is_more in zip(self._seen, more, strict=True) if is_more or number in kept]


def _moved(images: list[NDArray[np.uint8]]) -> float:
    """Way of things through images in a row (fraction of the longer side), as the sum of the medians over corners; 0
    where there are none, infinite where they are lost from one image to the next."""
    from ..sfm.flow import find_corners, follow  # numba, which what only checks a source does without

    way, points = 0.0, np.zeros((0, 2))
    for before, after in itertools.pairwise(images):
        if len(points) < _FEWEST:
            points = find_corners(before, np.zeros((0, 2)), _CORNERS, _APART_PX)
        if len(points) < _FEWEST:
            continue
        moved, found = follow(before, after, points, points)
        if found.sum() < _FEWEST:
            return np.inf
        way += float(np.median(np.linalg.norm(moved[found] - points[found], axis=1))) / max(after.shape)
        points = moved[found]
    return way


def _strides(steps: Sequence[float], images: Sequence[int]) -> list[int]:
    """Numbers of images after which one more is kept, for each step of so many images; 0 where it is not too large."""
    usual = [float(np.median(steps[max(0, k - _AROUND) : k + _AROUND + 1])) for k in range(len(steps))]
    strides: list[int] = []
    for is_far, run in itertools.groupby(zip(usual, images, strict=True), lambda step: step[0] > _FAR):
        together = list(run)
        too_far = is_far and max(way for way, _ in together) > _TOO_FAR
        strides += [max(1, int(_FAR * count / way)) if too_far else 0 for way, count in together]
    return strides
