"""A keyframe's depth completed where its views do not agree, at half the size.

What a view shows at its rim, or too blank from where it stands, others may see better: their sure depths are borrowed
where both show the same colour. The rest is a mixture of what geometry offers, weighed by a network.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.voxels import to_lab
from .candidates import LENT_CONFIDENCE, Array, Half, invert
from .evidence import Case
from .fill import SURE
from .network import inputs_of, middle_of, weigh_candidates

_MOST_CONFIDENCE, _FADING = 0.25, 0.05
"""Of a completed depth, and the expected error in log depth at which a part of 1 / e is left."""
_SMOOTHED, _LIKE_DEPTH = 1 / 75, 0.06
"""Standard deviation of a bilateral filter as a part of the longer side, and in log depth: what neighbouring pixels
take from other rows and columns differs by a few per cent."""
HALF, TWICE = np.diag([0.5, 0.5, 1]), np.diag([2.0, 2, 1, 1])
"""Bring a warp between pictures to half their size."""


def halved(depth: Array, confidence: Array, image: NDArray[np.uint8], contrast: Array) -> Half:
    """Reduce depth, confidence and contrast (H, W) to the size of the image (H/2, W/2, 3), both rounded up."""
    height, width = image.shape[:2]
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = []
    for values in (depth, np.where(depth > 0, confidence, 0)):
        whole = np.pad(values, pad, mode="edge").reshape(height, 2, width, 2)
        blocks.append(whole.transpose(0, 2, 1, 3).reshape(height, width, 4))
    best = blocks[1].argmax(-1)[..., None]
    found, sure = (np.take_along_axis(b, best, -1)[..., 0] for b in blocks)
    small = np.asarray(cv2.resize(contrast, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    return Half(invert(found), sure.astype(np.float32), image, to_lab(image), small)


def complete(case: Case, device: str) -> tuple[Array, Array]:
    """Return depth (h, w) at half the size, own, borrowed or completed, and its expected error in log depth (h, w)."""
    inverse = np.where(case.borrowed, case.lent, case.own.inverse)
    given = inputs_of(case, device)
    found = weigh_candidates(given, device)
    error = np.exp(found.log_doubt.cpu().numpy())
    if len(case.found.pixels):
        logs, risk = (x.cpu().numpy() for x in middle_of(found))
        inverse.ravel()[case.found.pixels] = np.exp(logs + np.float32(given.reference))
        smooth = cv2.bilateralFilter(np.log(np.maximum(inverse, 1e-9)), -1, _LIKE_DEPTH, max(inverse.shape) * _SMOOTHED)
        inverse = np.where(case.sure, inverse, np.exp(smooth))
        error.ravel()[case.found.pixels] = risk
    return invert(inverse), error


def trusted(case: Case, error: Array) -> Array:
    """Return (h, w) confidence at half the size: of what is not sure by its expected error alone."""
    sure = np.where(case.borrowed, LENT_CONFIDENCE, case.own.confidence)
    return np.where(case.sure, sure, _MOST_CONFIDENCE * np.exp(-error / _FADING)).astype(np.float32)


def as_completed(case: Case, device: str) -> Half:
    """Return the keyframe as others may ask it: what is not its own is unsure, however good."""
    depth, error = complete(case, device)
    mine = case.own.confidence >= SURE
    unsure = np.minimum(trusted(case, error), np.float32(_MOST_CONFIDENCE))
    return replace(case.own, inverse=invert(depth), confidence=np.where(mine, case.own.confidence, unsure))
