"""Whether images picked from a source still show the same things, one after the other."""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.video import VideoFrame
from ..sfm.flow import corners, follow
from .sharpness import reduce_image

_SIDE, _CORNERS, _APART_PX = 240, 60, 8.0
_FEWEST = 8
"""Corners by which a step is measured."""
_TOO_FAR, _FAR, _AROUND = 1 / 8, 1 / 16, 2
"""Of the longer side, in the median of a step and as many before and behind it: beyond the first, picked images hardly
overlap, and so it is before and behind where it is beyond the second. At ten images a second the largest of six videos
and a data set is 0.04 to 0.11, in a quick turn; that of six time-lapses 0.13 to 0.28."""


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
        """Return the picked numbers, and all that were seen between two of them where the steps are too large; before
        the first and behind the last as at the step beside it."""
        far = _too_large(self._steps)
        if not any(far):
            return self._picks
        step_of = np.searchsorted(self._picks, self._seen, side="right").clip(1, len(far)) - 1
        kept = set(self._picks)
        return [number for number, step in zip(self._seen, step_of, strict=True) if number in kept or far[step]]


def _moved(images: list[NDArray[np.uint8]]) -> float:
    """Median motion (fraction of the longer side) from the first to the last of images in a row; infinite where the
    corners are lost, 0 where there are none."""
    start = now = corners(images[0], np.zeros((0, 2)), _CORNERS, _APART_PX)
    if len(start) < _FEWEST:
        return 0.0
    for before, after in itertools.pairwise(images):
        moved, found = follow(before, after, now, now)
        start, now = start[found], moved[found]
    if len(start) < _FEWEST:
        return np.inf
    return float(np.median(np.linalg.norm(now - start, axis=1))) / max(images[0].shape)


def _too_large(steps: Sequence[float]) -> list[bool]:
    usual = [float(np.median(steps[max(0, k - _AROUND) : k + _AROUND + 1])) for k in range(len(steps))]
    far: list[bool] = []
    for is_far, run in itertools.groupby(usual, lambda step: step > _FAR):
        together = list(run)
        far += [is_far and max(together) > _TOO_FAR] * len(together)
    return far
