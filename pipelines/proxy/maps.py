"""The maps as they are stored: reliability of the depth, MSGS-SLAM eq. (2), fewer digits; and how alike labels are.

Digits that mean nothing are rounded off before the maps are compressed.
"""

import numpy as np
from numpy.typing import NDArray

from ..types import VOID, ProxyMaps

_CONFIDENCE_STEPS = 31
_LABEL_STEPS = 15
_SURE_BITS, _UNSURE_BITS = 11, 8
_SURE = 0.35

ALPHA, BETA = 0.7, 0.8
"""Eq. (2): how much depth edges lower the reliability; exponent of the depth's confidence."""
EDGE_STEP = 0.1
"""Unit of the log-depth gradient: a change of depth by 10 % from one pixel to the next. A wall or floor seen at an
angle stays far below it, an occlusion edge far above."""
_BLOCK = 256
"""Label images that are compared at once."""


def reliability(depth: NDArray[np.float32], confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """MSGS-SLAM eq. (2): `U = exp(-α‖∇ log D‖²) · Conf^β`, (h, w) in [0, 1]; 0 where the depth is unknown.

    The paper's third factor θ^γ of eq. (3), one number an image, is left out: it is 0.99 to 1.00.
    The gradient is that of the logarithm, so that U does not depend on the unit of depth, in units of EDGE_STEP.
    """
    edges = np.exp(-ALPHA * squared_log_gradient(depth) / EDGE_STEP**2)
    u = edges * np.power(np.clip(confidence, 0, 1), BETA)
    return np.where(depth > 0, u, 0).astype(np.float32)


def squared_log_gradient(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) squared gradient of log depth per pixel; the larger of the two one-sided differences in each direction.

    Differences to pixels of unknown depth count as 0.
    """
    known = depth > 0
    log_depth = np.log(np.where(known, depth, 1))
    total = np.zeros(depth.shape, np.float64)
    for axis in (0, 1):
        step = np.abs(np.diff(log_depth, axis=axis))
        step *= np.logical_and(np.delete(known, 0, axis), np.delete(known, -1, axis))
        before = np.insert(step, 0, 0, axis=axis)
        after = np.insert(step, step.shape[axis], 0, axis=axis)
        total += np.maximum(before, after) ** 2
    return total.astype(np.float32)


def mean_iou(first: NDArray[np.uint8], others: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(K,) of a label image (h, w) with others (K, h, w): the mean over the classes in either of intersection over
    union, where both are known; 0 when nothing is."""
    known = np.append(first[first != VOID], others[others != VOID])
    classes = int(known.max()) + 1 if len(known) else 1
    size = (classes + 1) ** 2
    mine = np.minimum(first, classes).ravel().astype(np.int64) * (classes + 1)
    out = [np.zeros(0)]
    for first_row in range(0, len(others), _BLOCK):
        block = np.minimum(others[first_row : first_row + _BLOCK], classes)
        place = np.arange(len(block))[:, None] * size + mine + block.reshape(len(block), -1)
        counts = np.bincount(place.ravel(), minlength=len(block) * size)
        both = counts.reshape(len(block), classes + 1, classes + 1)[:, :-1, :-1]
        shared = np.einsum("kcc->kc", both)
        union = both.sum(1) + both.sum(2) - shared
        out.append((shared / np.maximum(union, 1)).sum(1) / np.maximum((union > 0).sum(1), 1))
    return np.concatenate(out)


def compact(maps: ProxyMaps) -> ProxyMaps:
    """The maps with inverse depth rounded to 11 significant bits (8 where U is low) and confidences to few steps.

    Eleven bits are what half precision keeps: 0.02 % of the depth on average. A depth that is no number or too large
    for one is unknown (0) and of no confidence, and a confidence that is no number is 0.
    """
    with np.errstate(over="ignore"):
        inverse = np.divide(1, maps.depth, out=np.zeros_like(maps.depth), where=maps.depth > 0)
    bits = np.where(maps.confidence > _SURE, _SURE_BITS, _UNSURE_BITS)
    inverse = _round_bits(inverse, bits)
    with np.errstate(over="ignore"):
        depth = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0).astype(np.float32)
    known = np.isfinite(depth) & (depth > 0)
    return ProxyMaps(
        np.where(known, depth, np.float32(0)),
        np.where(known, _round_steps(maps.confidence, _CONFIDENCE_STEPS), np.float32(0)),
        maps.labels,
        _round_steps(maps.label_confidence, _LABEL_STEPS),
    )


def _round_bits(values: NDArray[np.float32], bits: NDArray[np.int64]) -> NDArray[np.float32]:
    mantissa, exponent = np.frexp(values)
    scale = np.ldexp(1.0, bits)
    return np.ldexp(np.round(mantissa * scale) / scale, exponent).astype(np.float32)


def _round_steps(values: NDArray[np.float32], steps: int) -> NDArray[np.float32]:
    return (np.round(np.clip(np.nan_to_num(values), 0, 1) * steps) / steps).astype(np.float32)
