"""Weights of keyframes from covisibility (MSGS-SLAM eqs. 13, 14)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def keyframe_weights(
    now: int, reliability: NDArray[np.float64], time_decay: float, reliability_decay: float
) -> NDArray[np.float64]:
    """(N,) eq. (13) with ρ = 1: exp(-τ (now - t)) exp(-δ (1 - mean U)), eq. (14); `reliability` (N,) is mean U."""
    age = np.maximum(now - np.arange(len(reliability)), 0)
    return np.exp(-time_decay * age) * np.exp(-reliability_decay * (1 - reliability))
