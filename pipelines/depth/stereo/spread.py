"""Spreading sparse or doubtful labels over an image along like colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel


def spread_votes(
    votes: NDArray[np.float32], image: NDArray[np.uint8], reach: float, color_sd: float
) -> NDArray[np.float32]:
    """(h, w, C) votes smoothed along the image (h, w, 3) by the domain transform (Gastal and Oliveira, SIGGRAPH 2011):
    a vote fades over `reach` pixels of like colour, and faster where the colour changes by about `color_sd`."""
    out = np.array(votes, np.float32, order="C")
    spread_in_place(out, image, reach, color_sd)
    return out


def spread_in_place(votes: NDArray[np.float32], image: NDArray[np.uint8], reach: float, color_sd: float) -> None:
    """Do what `spread_votes` does to votes that nobody else has, without a second copy of all classes."""
    for iteration in range(2):
        fade = np.exp(-np.sqrt(2.0) / (reach * 0.5**iteration))
        _pass_rows(votes, _fading(image, 1, fade, reach / color_sd))
        _pass_columns(votes, _fading(image, 0, fade, reach / color_sd))


def _fading(image: NDArray[np.uint8], axis: int, fade: float, stretch: float) -> NDArray[np.float32]:
    """(h, w) how much of a vote is left after the step from the pixel before along the axis; the first are 0."""
    red, green, blue = np.moveaxis(np.abs(np.diff(image.astype(np.float32), axis=axis)), -1, 0)
    left = np.power(np.float32(fade), 1 + np.float32(stretch) * (red + green + blue))
    return np.asarray(np.insert(left, 0, 0, axis=axis), np.float32)


@kernel
def _pass_rows(votes: NDArray[np.float32], fading: NDArray[np.float32]) -> None:
    height, width, classes = votes.shape
    for y in range(height):
        for x in range(1, width):
            for c in range(classes):
                votes[y, x, c] += fading[y, x] * (votes[y, x - 1, c] - votes[y, x, c])
        for x in range(width - 2, -1, -1):
            for c in range(classes):
                votes[y, x, c] += fading[y, x + 1] * (votes[y, x + 1, c] - votes[y, x, c])


@kernel
def _pass_columns(votes: NDArray[np.float32], fading: NDArray[np.float32]) -> None:
    height, width, classes = votes.shape
    for y in range(1, height):
        for x in range(width):
            for c in range(classes):
                votes[y, x, c] += fading[y, x] * (votes[y - 1, x, c] - votes[y, x, c])
    for y in range(height - 2, -1, -1):
        for x in range(width):
            for c in range(classes):
                votes[y, x, c] += fading[y + 1, x] * (votes[y + 1, x, c] - votes[y, x, c])
