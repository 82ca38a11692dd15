"""Depth where the views do not agree: planes through regions of one colour, else what lies along like colours.

Walls and cupboards without texture cannot be matched, but their borders can, and they are mostly flat.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.proxy.graph_cut import cut_image
from pipelines.proxy.regions.spread import spread_votes
from pipelines.proxy.stereo.gaps import IN_FRONT, behind_bars
from pipelines.proxy.stereo.planes import LEAST_PIXELS, region_planes

SURE = 0.3
"""Confidence from which a depth is evidence and stays as it is."""
_PLANE_CONFIDENCE, _SPREAD_CONFIDENCE, _GUESS_CONFIDENCE = 0.2, 0.1, 0.03
_REGION_SCALE = 250.0
_REACH, _COLOR_SD = 40.0, 30.0


def fill_unsure(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    image: NDArray[np.uint8],
    textured: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) depth and confidence with every unsure depth replaced by a guess of low confidence; image (h, w, 3).

    textured (h, w): where the picture has something to match. Elsewhere a depth came from its surroundings, which in
    a gap between bars are the bars: it is not sure there if what is seen through the gaps lies behind it.
    """
    sure = (confidence >= SURE) & (depth > 0)
    if sure.sum() < LEAST_PIXELS:
        return depth, np.minimum(confidence, SURE)
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    low, high = np.quantile(inverse[sure], [0.002, 0.998])
    through = behind_bars(inverse, sure & textured, ~textured, image)
    sure &= ~(through.gap & (inverse > (1 + IN_FRONT) * through.inverse))
    weight = np.where(sure, confidence, 0).astype(np.float64)
    spread, reached = _along_colors(inverse, weight, image)
    plane, fit = region_planes(inverse, weight, cut_image(image, _REGION_SCALE))
    plane, fit = np.where(through.known, through.inverse, plane), np.where(through.known, 1.0, fit)
    flat = ~sure & (fit > 0.5) & (plane > 0.7 * low) & (plane < 1.3 * high)
    near = ~sure & ~flat & (reached > 1e-4)
    guess = np.where(flat, plane, np.where(near, spread, inverse))
    filled = np.where(sure, depth, np.divide(1.0, guess, out=np.zeros(depth.shape), where=guess > 0))
    trust = np.where(flat, _PLANE_CONFIDENCE * fit, np.where(near, _SPREAD_CONFIDENCE, _GUESS_CONFIDENCE))
    return filled.astype(np.float32), np.where(sure, confidence, trust * (filled > 0)).astype(np.float32)


def _along_colors(
    inverse: NDArray[np.float64], weight: NDArray[np.float64], image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    votes = np.stack([weight, weight * inverse], axis=-1).astype(np.float32)
    votes = spread_votes(votes, image, _REACH, _COLOR_SD).astype(np.float64)
    return np.asarray(votes[..., 1] / np.maximum(votes[..., 0], 1e-12), np.float64), np.asarray(
        votes[..., 0], np.float64
    )
