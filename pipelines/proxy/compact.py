"""Less to store: digits that mean nothing are rounded off before the maps are compressed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import ProxyMaps

_CONFIDENCE_STEPS = 31
_LABEL_STEPS = 15
_SURE_BITS, _UNSURE_BITS = 11, 8
_SURE = 0.35


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
