"""Spreading sparse or doubtful labels over an image along like colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.jit import kernel


def spread_votes(
    votes: NDArray[np.float32], image: NDArray[np.uint8], reach: float, color_sd: float
) -> NDArray[np.float32]:
    """(h, w, C) votes smoothed along the image (h, w, 3) by the domain transform (Gastal and Oliveira, SIGGRAPH 2011):
    a vote fades over `reach` pixels of like colour, and faster where the colour changes by about `color_sd`."""
    out = votes.astype(np.float32).copy()
    for iteration in range(2):
        sigma = reach * 0.5**iteration
        _pass_rows(out, image, float(np.exp(-np.sqrt(2.0) / sigma)), reach / color_sd)
        turned = np.ascontiguousarray(out.transpose(1, 0, 2))
        side = np.ascontiguousarray(image.transpose(1, 0, 2))
        _pass_rows(turned, side, float(np.exp(-np.sqrt(2.0) / sigma)), reach / color_sd)
        out = np.ascontiguousarray(turned.transpose(1, 0, 2))
    return out


@kernel
def _pass_rows(votes: NDArray[np.float32], image: NDArray[np.uint8], fade: float, stretch: float) -> None:
    height, width, classes = votes.shape
    feedback = np.empty(width, np.float32)
    for y in range(height):
        for x in range(1, width):
            change = np.float64(0)
            for c in range(3):
                change += abs(np.float32(image[y, x, c]) - np.float32(image[y, x - 1, c]))
            feedback[x] = fade ** (1 + stretch * change)
        for x in range(1, width):
            f = feedback[x]
            for c in range(classes):
                votes[y, x, c] += f * (votes[y, x - 1, c] - votes[y, x, c])
        for x in range(width - 2, -1, -1):
            f = feedback[x + 1]
            for c in range(classes):
                votes[y, x, c] += f * (votes[y, x + 1, c] - votes[y, x, c])
