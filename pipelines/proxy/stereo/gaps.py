"""What is seen through the gaps of a railing: an even wall there has nothing to match, and takes the depth of the bars.

Its parts look alike across the bars, so they are one surface; what that surface borders on says where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from pipelines.proxy.stereo.planes import LEAST_PIXELS, fit_planes

IN_FRONT = 0.05
"""Relative difference of inverse depth by which something stands before a plane."""
_LAGS = range(3, 15, 2)
"""Widths in pixels of bars that are looked across, of a picture of 320."""
_ALIKE = 12
"""Grey levels by which what is seen on both sides may differ."""
_JOIN = 2.0
"""Parts are joined by so many pairs of pixels for each pixel of the smaller one's side."""
_LEAST_PARTS = 4
"""Three bars make a railing; two parts of a table top that a tray divides do not."""
_BORDER = 5
_FARTHEST = 0.03
"""Share of the evidence along the border that may lie behind the plane: wrong matches."""
_RAILING, _TOUCHING = 0.5, 60
"""Share of the evidence that has to stand before the plane, and number of pixels that have to lie on it."""


@dataclass(frozen=True)
class Behind:
    """inverse (h, w): inverse depth of the surfaces seen through gaps, where `known` (h, w); gap (h, w): the gaps."""

    inverse: NDArray[np.float64]
    known: NDArray[np.bool_]
    gap: NDArray[np.bool_]


def behind_bars(
    inverse: NDArray[np.float64], evidence: NDArray[np.bool_], even: NDArray[np.bool_], image: NDArray[np.uint8]
) -> Behind:
    """Planes of the surfaces that are even (h, w), without texture, and seen in several parts between bars.

    inverse (h, w): inverse depth, to be relied on where `evidence`; image (h, w, 3).
    """
    parts = _even_parts(even)
    region = _join_across(parts, image)
    if not region.any():
        nowhere = np.zeros(inverse.shape, bool)
        return Behind(np.zeros_like(inverse), nowhere, nowhere)
    plane, known = _planes_behind(inverse, evidence, region)
    return Behind(plane, known, known & _smaller_parts(parts, region))


def _even_parts(even: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(h, w) connected parts without texture, from 1; 0 elsewhere, and for what is too small to count."""
    opened = cv2.morphologyEx(even.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, parts, figures, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    number = np.cumsum(figures[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS) - 1
    number[figures[:, cv2.CC_STAT_AREA] < LEAST_PIXELS] = 0
    return np.asarray(number, np.int64)[parts]


def _smaller_parts(parts: NDArray[np.int64], region: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(h, w) what belongs to a region of several parts and is not its largest: a surface seen through gaps."""
    area = np.bincount(parts.ravel())[parts]
    largest = np.zeros(int(region.max()) + 1, np.int64)
    np.maximum.at(largest, region.ravel(), area.ravel())
    return np.asarray((parts > 0) & (area < largest[region]))


def _join_across(parts: NDArray[np.int64], image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """(h, w) parts > 0 that look alike on both sides of a thin thing made one region: the wall behind a railing; 0
    for those that stay alone."""
    count = int(parts.max()) + 1
    color = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.int16)
    pairs = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        for lag in _LAGS:
            here, there = _shifted(parts.shape, dy * lag, dx * lag)
            a, b = parts[here], parts[there]
            y, x = np.nonzero((a != b) & (a > 0) & (b > 0))
            alike = np.abs(color[here][y, x] - color[there][y, x]).max(-1) < _ALIKE
            a, b = a[y, x][alike], b[y, x][alike]
            pairs.append(np.minimum(a, b) * count + np.maximum(a, b))
    packed, votes = np.unique(np.concatenate(pairs), return_counts=True)
    a, b = np.divmod(packed, count)
    area = np.bincount(parts.ravel(), minlength=count)
    enough = votes >= _JOIN * np.sqrt(np.minimum(area[a], area[b]))
    graph = coo_matrix((np.ones(enough.sum()), (a[enough], b[enough])), shape=(count, count))
    joined = connected_components(graph, directed=False)[1]
    several = np.bincount(joined)[joined] >= _LEAST_PARTS
    return np.where(several, joined + 1, 0)[parts]


def _shifted(shape: tuple[int, ...], dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of all pixels that have another (dy, dx) away, and of those others."""
    height, width = shape

    def both(step: int, size: int) -> tuple[slice, slice]:
        return slice(max(0, -step), max(0, size - max(0, step))), slice(max(0, step), max(0, size + min(0, step)))

    (y, y_there), (x, x_there) = both(dy, height), both(dx, width)
    return (y, x), (y_there, x_there)


def _planes_behind(
    inverse: NDArray[np.float64], evidence: NDArray[np.bool_], region: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(h, w) inverse depth of the planes of regions > 0, and where it may be believed.

    Of the evidence that a region borders the nearest depth within some pixels counts, that of the border's own thing.
    What bounds an even surface stands before it or lies on it, so that its plane goes through the farthest of it.
    """
    groups, places, values = [], [], []
    index = np.arange(region.size).reshape(region.shape)
    known = np.where(evidence & (region == 0), inverse, 0)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (-1, -1), (-1, 1)):
        nearest = np.zeros_like(inverse)
        for lag in range(1, _BORDER + 1):
            here, there = _shifted(region.shape, dy * lag, dx * lag)
            nearest[here] = np.maximum(nearest[here], known[there])
        beside = (region > 0) & (nearest > 0)
        groups.append(region[beside])
        places.append(index[beside])
        values.append(nearest[beside])
    group, used, value = np.concatenate(groups), np.concatenate(places), np.concatenate(values)
    plane, share = fit_planes(region, group, used, value, np.ones(len(used)), _FARTHEST)
    count = np.maximum(np.bincount(group, minlength=int(region.max()) + 1), 1)
    before = np.bincount(group, value > (1 + IN_FRONT) * plane.ravel()[used], len(count)) / count
    return plane, (region > 0) & (before[region] > _RAILING) & (share * count[region] > _TOUCHING)
