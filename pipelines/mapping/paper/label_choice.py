"""Keyframes by what they show, MSGS-SLAM eq. (12): a new one is paired with those whose labels differ from its own."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.mapping.views import View
from msgs_slam.pipelines.proxy.reliability import semantic_agreement

_GRID = (40, 30)


def label_likeness(views: Sequence[View]) -> NDArray[np.float64]:
    """(N, N) mean IoU of the views' label images, sampled on a grid; 0 where nothing is known, 1 on the diagonal.

    The paper keeps at most 20 of those below T_sem for one step of its mapping; a step here visits one.
    """
    small = [
        np.asarray(cv2.resize(v.channels.cpu().numpy(), _GRID, interpolation=cv2.INTER_NEAREST), np.uint8)
        for v in views
    ]
    out = np.eye(len(views))
    for i, first in enumerate(small):
        for j, second in enumerate(small[:i]):
            out[i, j] = out[j, i] = semantic_agreement(first, second) or 0.0
    return out
