"""Keyframes by parallax: how far points tracked from the last keyframe have moved."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..sfm.flow import corners, follow
from ..source.sharpness import reduce_image

_TRACKED_SIDE = 480
_MAX_CORNERS = 600
_MIN_TRACKS = 30
_APART_PX = 6.0
_LEVELS = 4
_MIN_SURVIVORS = 0.5
"""With fewer of its tracks left there is a new keyframe in any case."""


@dataclass(frozen=True)
class KeyframeChoice:
    """keyframes: indices of the chosen frames; displacement (N,): median displacement of each frame from the keyframe
    before it, as a fraction of the width, infinite where the tracks were lost."""

    keyframes: list[int]
    displacement: NDArray[np.float64]

    @property
    def largest_displacement(self) -> float:
        """Largest displacement that was seen, as a fraction of the width."""
        return float(self.displacement.max(initial=0.0))


def choose_keyframes(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]], parallax: float
) -> KeyframeChoice:
    """Keyframes of grey frames (H, W) in order of time, each with a mask (H, W) of what is no part of the scene: one
    whenever points have moved by `parallax`, as a fraction of the width; the first, and the last where it adds a view.
    """
    tracker = _Tracker()
    keyframes: list[int] = []
    displacement: list[float] = []
    count = 0
    for i, (frame, left_out) in enumerate(frames):
        gray = reduce_image(frame, _TRACKED_SIDE)
        moved, survivors = tracker.advance(gray)
        displacement.append(moved)
        if i == 0 or moved > parallax or survivors < _MIN_SURVIVORS:
            keyframes.append(i)
            tracker.restart(gray, left_out)
        count = i + 1
    if keyframes and keyframes[-1] != count - 1 and displacement[-1] > parallax / 3:
        keyframes.append(count - 1)
    return KeyframeChoice(keyframes, np.array(displacement, dtype=np.float64))


class _Tracker:
    """Follows the last keyframe's corners from frame to frame, each step checked by tracking back."""

    def __init__(self) -> None:
        self._previous: NDArray[np.uint8] | None = None
        self._origin = np.zeros((0, 2))
        self._points = np.zeros((0, 2))
        self._started = 0

    def restart(self, gray: NDArray[np.uint8], left_out: NDArray[np.bool_] | None) -> None:
        """Take `gray`, the frame advanced to last, as the keyframe."""
        if left_out is not None:
            left_out = cv2.resize(left_out.astype(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        self._origin = self._points = corners(gray, self._origin[:0], _MAX_CORNERS, _APART_PX, left_out)
        self._started = len(self._origin)

    def advance(self, gray: NDArray[np.uint8]) -> tuple[float, float]:
        """Median displacement since the keyframe (fraction of the width) and the share of its tracks that live."""
        previous, self._previous = self._previous, gray
        if previous is None:
            return 0.0, 1.0
        if self._started == 0:  # the keyframe showed nothing: the next one is what shows something
            sees = len(corners(gray, self._origin[:0], _MAX_CORNERS, _APART_PX, None)) >= _MIN_TRACKS
            return 0.0, 0.0 if sees else 1.0
        if len(self._points):
            moved, found = follow(previous, gray, self._points, self._points, _LEVELS)
            self._origin, self._points = self._origin[found], moved[found]
        survivors = len(self._points) / self._started
        if len(self._points) < min(_MIN_TRACKS, self._started):
            return np.inf, survivors
        distance = np.linalg.norm(self._points - self._origin, axis=1)
        return float(np.median(distance)) / gray.shape[1], survivors
