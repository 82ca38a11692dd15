"""Detection of what stands still in the image while the rest of it moves: it belongs to the camera, not to the scene.

A bonnet, a handlebar, a display that is burnt in, the frame around a screen recording. Over moments between which the
image changed, the gradients of a scene that moves cancel out in the mean, and those of what stands still remain (as
watermarks are found in a collection of images by Dekel et al., CVPR 2017). Counted are moments, not seconds: while the
camera stands, everything does. What is as still as that by chance is long and straight along the motion, such as the
edge of a road, so that each part needs corners.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..source.picking import reduce_image

SAMPLED = 60
"""Frames of a recording, evenly spaced."""
_SIDE = 480
_EDGE = 4.0
"""Grey levels across two pixels from which a gradient is one: all below is noise, compression and shading."""
_FINE, _COARSE = 1.0, 1.7
"""Pixels by which images are blurred, and again where motion is looked for: noise in the dark is no motion."""
_FIRM, _LOOSE = 0.8, 0.5
"""Share of the moments in which a gradient is there, in parts that stand still, and in what is connected with them. In
14 recordings where nothing does, one pixel in a thousand has up to 0.45, and 0.78 where the camera hardly moves."""
_CONSTANT = 3.0
"""Standard deviation in grey levels up to which a plain pixel does not change."""
_WINDOW, _CORNER = 15, 0.1
"""Pixels of the window whose gradients make a corner, and ratio of the smaller to both eigenvalues of their structure
tensor."""
_MIN_CORNERS, _MIN_IN_ALL, _DENSE = 12, 100, 0.09
"""Pixels of corners in a part, and in all parts: the point towards which a camera moves has up to 60 around it, and
fewer give a handful of features, which no geometry follows. And their share of the gradients of a part: displays have
0.14 and more, a translucent word 0.1, what trembles far away by a pixel 0.04, a wall before which people walk 0.08."""
_RIM = 4
"""Pixels at the border of the image that say nothing: some cameras leave black lines there."""
_GAP, _MARGIN, _HOLE = 0.015, 3, 0.01
"""Share of the long side over which pieces are one part; pixels that are left out around it; share of the image up to
which what it encloses belongs to it."""
_MIN_MOMENTS, _MIN_CHANGE = 8, 0.05
"""Moments, and share of the gradients that change in the long run, without which there is no evidence."""
_VEIL = 0.2
"""Share of the image over which something translucent stands still, from which it is no display but lies over all."""


@dataclass(frozen=True)
class StillPart:
    """The part of the image that stands still (h, w), and the share of the image over which a reflection does, which
    cannot be left out."""

    left_out: NDArray[np.bool_]
    veil: float = 0.0


def find_still(pictures: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]) -> StillPart | None:
    """Find what stands still in grey images (H, W), each with a mask (H, W) of what is left out already; None without
    evidence that anything moves. The result has at most 480 pixels along the long side."""
    reduced = [_reduced(*picture) for picture in pictures]
    if len(reduced) < _MIN_MOMENTS or len({grey.shape for grey, _ in reduced}) > 1:
        return None
    moments = _moments([(_blurred(grey, _COARSE), left_out) for grey, left_out in reduced])
    if len(moments) < _MIN_MOMENTS:
        return None
    gradient, presence, spread = _statistics([reduced[i] for i in moments])
    strength = (gradient**2).sum(0)
    constant = spread < _CONSTANT
    loose = (presence > _LOOSE) & (strength > (_EDGE / 2) ** 2)
    corners = _corners(gradient, (presence > _FIRM) & (strength > _EDGE**2))
    veil = float((_parts(loose, _corners(gradient, loose), loose) & ~close_gaps(constant)).mean())
    if veil > _VEIL:
        return StillPart(_parts(constant, corners, loose), veil)
    return StillPart(_parts(constant | loose, corners, loose))


_Reduced = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]


def _reduced(grey: NDArray[np.uint8], left_out: NDArray[np.bool_] | None) -> _Reduced:
    small = _blurred(reduce_image(grey, _SIDE), _FINE)
    if left_out is None:
        return small, None
    hidden = cv2.resize(left_out.astype(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return small, cv2.dilate(hidden, _disc(_MARGIN + 2)) > 0


def _blurred(grey: NDArray[np.uint8], sigma: float) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma), np.uint8)


def _gradient(picture: _Reduced) -> NDArray[np.float32]:
    """(2, h, w) grey levels across two pixels, 0 in what is left out."""
    grey, left_out = picture
    axes = [cv2.Sobel(grey, cv2.CV_32F, *axis, ksize=1) for axis in ((1, 0), (0, 1))]
    found: NDArray[np.float32] = np.stack(axes).astype(np.float32, copy=False)
    if left_out is not None:
        found[:, left_out] = 0
    return found


def _moments(pictures: Sequence[_Reduced]) -> list[int]:
    """Frames between which half of what can change has changed; [] where next to nothing does."""
    count = len(pictures)
    far = [_changed(_gradient(pictures[i]), _gradient(pictures[(i + count // 2) % count]))
           for i in range(0, count, max(1, count // 12))]  # fmt: skip
    most = float(np.percentile(far, 75))
    if most < _MIN_CHANGE:
        return []
    moments, before = [0], _gradient(pictures[0])
    for i in range(1, count):
        now = _gradient(pictures[i])
        if _changed(before, now) >= most / 2:
            moments.append(i)
            before = now
    return moments


def _changed(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Share of the gradients of either image that differ."""
    both = (first**2).sum(0), (second**2).sum(0)
    strong = np.maximum(*both) > _EDGE**2
    return float((((first - second) ** 2).sum(0) > 0.5 * (both[0] + both[1]))[strong].mean()) if strong.any() else 0.0


def _statistics(pictures: Sequence[_Reduced]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Mean gradient (2, h, w), in what share of the images it is there and standard deviation of grey (h, w)."""
    shape = pictures[0][0].shape
    total, squares, energy = np.zeros((2, *shape), np.float32), np.zeros(shape), np.zeros(shape, np.float32)
    grey = np.zeros(shape)
    for picture in pictures:
        gradient, value = _gradient(picture), picture[0].astype(np.float64)
        total += gradient
        energy += (gradient**2).sum(0)
        grey += value
        squares += value**2
    count = len(pictures)
    mean: NDArray[np.float32] = (total / count).astype(np.float32, copy=False)
    presence = (mean**2).sum(0) / np.maximum(energy / count, 1e-6)
    spread = np.sqrt(np.maximum(squares / count - (grey / count) ** 2, 0))
    return mean, presence.astype(np.float32), spread.astype(np.float32)


def _corners(gradient: NDArray[np.float32], firm: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) which of the firm pixels lie among gradients of more than one direction, away from the border."""
    inside = np.zeros(firm.shape, np.bool_)
    inside[_RIM:-_RIM, _RIM:-_RIM] = firm[_RIM:-_RIM, _RIM:-_RIM]
    x, y = gradient * inside
    xx, xy, yy = (cv2.boxFilter(v, -1, (_WINDOW, _WINDOW)) for v in (x * x, x * y, y * y))
    smaller = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    return np.asarray(inside & (smaller > _CORNER * (xx + yy)))


def _parts(candidates: NDArray[np.bool_], corners: NDArray[np.bool_], loose: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) pieces of candidates with enough corners, joined over small gaps, with what they enclose and a margin."""
    _, piece = cv2.connectedComponents(close_gaps(candidates).astype(np.uint8))
    count, gradients = (np.bincount(piece.ravel(), found.ravel()) for found in (corners, loose))
    kept = (count >= _MIN_CORNERS) & (count > _DENSE * gradients)
    kept[0] = False
    if count[kept].sum() < _MIN_IN_ALL:
        return np.zeros(candidates.shape, np.bool_)
    found = np.asarray(kept[piece])
    _, hole, stats, _ = cv2.connectedComponentsWithStats((~found).astype(np.uint8))
    small = stats[:, cv2.CC_STAT_AREA] < _HOLE * found.size
    small[0] = False
    return np.asarray(cv2.dilate((found | small[hole]).astype(np.uint8), _disc(_MARGIN)) > 0)


def close_gaps(mask: NDArray[np.bool_], gap: float = _GAP) -> NDArray[np.bool_]:
    """Join the pieces of a mask (h, w) over gaps of at most twice this share of its longer side."""
    reach = max(1, round(gap * max(mask.shape)))
    around = cv2.copyMakeBorder(mask.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, _disc(reach))
    return np.asarray(closed[reach:-reach, reach:-reach] > 0)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
