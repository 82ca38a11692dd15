"""Depths and labels at another size: nothing is averaged across an edge, and nothing moves aside."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import ProxyMaps

_ONE_SURFACE = 0.02
"""Relative standard deviation up to which depths side by side are of one surface."""


def resample_nearest(array: NDArray, height: int, width: int) -> NDArray:
    """(H, W, ...) → (height, width, ...): each pixel takes the value under its centre."""
    rows = ((np.arange(height) + 0.5) * array.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * array.shape[1] / width).astype(np.int64)
    return np.ascontiguousarray(array[rows[:, None], columns[None, :]])


def resize_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """(H, W) → (height, width): of a smaller image the mean of what each pixel covers, where that is one surface and
    known whole; else the value under its centre.

    The mean of the inverse, which is linear on a plane. Under the centre of two by two pixels is their corner: one of
    them is half a pixel aside, which is per cents of the depth where a floor recedes.
    """
    nearest = resample_nearest(depth, height, width)
    if height >= depth.shape[0] or width >= depth.shape[1]:
        return nearest
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan).astype(np.float32)
    mean, square = (cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA) for x in (inverse, inverse**2))
    is_one = square < (1 + _ONE_SURFACE**2) * mean**2  # not so of NaN
    return np.where(is_one, 1 / mean, nearest).astype(np.float32)


def resize_maps(maps: ProxyMaps, height: int, width: int) -> ProxyMaps:
    """All of a frame's maps at another size."""
    if maps.depth.shape == (height, width):
        return maps
    sampled = (resample_nearest(m, height, width) for m in (maps.confidence, maps.labels, maps.label_confidence))
    return ProxyMaps(resize_depth(maps.depth, height, width), *sampled)
