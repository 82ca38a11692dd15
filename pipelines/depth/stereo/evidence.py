"""The worth of a match: views of a blank surface agree on anything, and views that do not see a place say nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...compute.jit import kernel
from .window import LIKENESS, pad_rows, row_length, weigh_windows

_FAINT, _POWER = 5e-5, 0.25
"""Variance (intensities 0..1; two grey levels) and power by which agreement on a blank surface counts less."""
_CLEAR = 2e-4
"""Variance from which a match can be preferred to a guess."""


@kernel
def surface_contrast(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) variance of the intensities (0..1) of each pixel's window, which count by how like the pixel they are: of
    a blank surface it is small also beside its border."""
    height, width = image.shape
    length, contrast = row_length(width), np.empty((height, width), np.float32)
    for y in range(height):
        contrast[y] = weigh_windows(pad_rows(image, y, y + 1), length, LIKENESS)[1][length : length + width]
    return contrast


def evidence_of(contrast: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) factor in [0, 1] of the confidence of a match, by the variance around it."""
    return np.power(contrast / (contrast + np.float32(_FAINT)), np.float32(_POWER))


def prefer_matches(
    filled: NDArray[np.float32],
    matched: NDArray[np.float32],
    borne_out: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    contrast: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(h, w) filled depths, and matched ones (0 where none) where `borne_out` (agreeing less contradicting views)
    is larger for them and there was something to match; it is asked of no other pixels, which are 0.

    What lies beside a near thing is seen by too few views to be sure, and a plane through what is sure would draw the
    near thing over it.
    """
    asked = (matched > 0) & (contrast > _CLEAR)
    better = borne_out(np.where(asked, matched, 0)) > borne_out(np.where(asked, filled, 0))
    return np.where(asked & better, matched, filled)
