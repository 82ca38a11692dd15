"""Sure depths of other views where a view itself is unsure.

What it shows at its rim, or too blank from where it stands, others may see better. A surface that nobody is sure of
does not hide what lies behind it, so a depth is taken only where both views show the same colour.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel
from .fill import SURE

_COLOR_SD = 3.0
_LIGHT = 0.5
"""A difference in lightness counts so much: exposure and shading change it from view to view."""
_AGREE = 0.02
_IN_FRONT = 0.98
_LEAST = 0.5
"""Likeness of colour that the agreeing views must have together; a view of the same colour counts 1. By the depth of
six rooms' proxies 1.0 is 1 to 4 % worse on three and 0.2 % better on three; of three, 0.25 is 1 % worse on two."""
_BORROWED_CONFIDENCE = 0.35


def borrow_depth(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    lent: NDArray[np.float32],
    mass: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) depth and confidence with the unsure ones taken from what the others agree on, as `agreed_depth` says."""
    taken = (confidence < SURE) & (mass > _LEAST)
    return np.where(taken, lent, depth), np.where(taken, np.float32(_BORROWED_CONFIDENCE), confidence)


def agreed_depth(
    carried: list[tuple[NDArray[np.float32], NDArray[np.float32]]], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, w) mean of the carried depths that most likeness agrees on, and the sum of that likeness; 0 where it is not
    wanted (h, w)."""
    depths, likeness = (np.stack(part) for part in zip(*carried, strict=True))
    return _agree(depths, likeness, wanted)


def carry_depth(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    lab: NDArray[np.float32],
    warp: NDArray[np.float64],
    target: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The sure depths of another view as this one would see them (0 where none), and how alike the colours are.

    `warp` (3, 4) leads from the other view's pixels to this view's; `lab` and `target` (h, w, 3) are their pictures.
    """
    carried = np.zeros(depth.shape, np.float32)
    apart = np.zeros(depth.shape, np.float32)
    _splat(depth, confidence, lab, warp, target, carried, apart)
    return carried, np.where(carried > 0, np.exp(-apart / (2 * _COLOR_SD**2)), 0).astype(np.float32)


@kernel
def _splat(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    lab: NDArray[np.float32],
    warp: NDArray[np.float64],
    target: NDArray[np.float32],
    carried: NDArray[np.float32],
    apart: NDArray[np.float32],
) -> None:
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if z <= 0 or confidence[y, x] < SURE:
                continue
            u, v = x + 0.5, y + 0.5
            qx = z * (warp[0, 0] * u + warp[0, 1] * v + warp[0, 2]) + warp[0, 3]
            qy = z * (warp[1, 0] * u + warp[1, 1] * v + warp[1, 2]) + warp[1, 3]
            qz = z * (warp[2, 0] * u + warp[2, 1] * v + warp[2, 2]) + warp[2, 3]
            if qz <= 0:
                continue
            left, top = np.floor(qx / qz - 0.5), np.floor(qy / qz - 0.5)
            # Four pixels, so that a view from farther off leaves no holes; the nearest depth wins.
            for row in range(max(top, 0), min(top + 2, height)):
                for column in range(max(left, 0), min(left + 2, width)):
                    before = carried[row, column]
                    if before == 0 or qz < before * _IN_FRONT:
                        carried[row, column] = qz
                        lightness = target[row, column, 0] - lab[y, x, 0]
                        red = target[row, column, 1] - lab[y, x, 1]
                        yellow = target[row, column, 2] - lab[y, x, 2]
                        apart[row, column] = _LIGHT * lightness**2 + red**2 + yellow**2


@kernel
def _agree(
    lent: NDArray[np.float32], likeness: NDArray[np.float32], wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    views, height, width = lent.shape
    found = np.zeros((height, width), np.float32)
    mass = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if not wanted[y, x]:
                continue
            for a in range(views):
                z = lent[a, y, x]
                if z <= 0:
                    continue
                total = 0.0
                inverse = 0.0
                for b in range(views):
                    other = lent[b, y, x]
                    if other > 0 and abs(other - z) < _AGREE * z:
                        total += likeness[b, y, x]
                        inverse += likeness[b, y, x] / other
                if total > mass[y, x] and inverse > 0:
                    mass[y, x] = total
                    found[y, x] = total / inverse
    return found, mass
