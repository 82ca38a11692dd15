"""Depths that a pixel without a sure match could have: what geometry says from along its row and column, and planes.

All are inverse depths: in a picture that of a plane is linear.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.fill import _EVIDENCE_POWER, _local_planes
from msgs_slam.pipelines.system.jit import kernel

KINDS = (
    "fill", "own", "lent", "left", "right", "above", "below", "left line", "right line", "above line", "below line",
    "across", "upright", "plane", "second plane", "third plane", "fourth plane",
)  # fmt: skip
_LINES, _ACROSS, _PLANES = 3, 11, 13
_FADE = 0.04
"""Of the image's longer side: over this length a sure depth's say in the line through it fades."""
_STEP = 0.04
"""Relative difference to the line at which another surface begins."""
_FLAT = 6.0
"""Squared pixels added to the spread of places: short lines are kept flat."""
_MOST_PLANES, _HYPOTHESES, _LEAST_INLIERS, _AROUND = 12, 160, 60, 1000
_ON, _TAKEN = 0.012, 0.018
"""Relative distance in inverse depth: up to the first a point lies on a plane, from the second on it is left for
others."""
_REACH = 0.12
"""Of the longer side: how far apart the three points of a hypothesis are at most."""


@dataclass(frozen=True)
class Known:
    """What is known of a keyframe before anything is chosen, at half the size of the stereo; all (h, w).

    inverse and confidence of the match (0: none); lent inverse depth by other keyframes, and how much they agree.
    """

    inverse: NDArray[np.float32]
    confidence: NDArray[np.float32]
    lent: NDArray[np.float32]
    mass: NDArray[np.float32]


@dataclass(frozen=True)
class Candidates:
    """Of P pixels (flat indices): inverse depths (P, K), 0 where a kind says nothing; flat index of the sure pixel that
    speaks (P, K), the pixel itself where there is none; how much there is behind it (P, K)."""

    pixels: NDArray[np.int64]
    inverse: NDArray[np.float32]
    support: NDArray[np.int32]
    weight: NDArray[np.float32]


def find_candidates(
    known: Known,
    sure: NDArray[np.bool_],
    image: NDArray[np.uint8],
    planes: NDArray[np.float64],
    pixels: NDArray[np.int64],
) -> Candidates:
    """The candidates at pixels, from the `sure` ones (h, w), the picture (h, w, 3) and planes (N, 3) as
    `inverse depth = plane @ (x, y, 1)` in pixels."""
    evidence = np.where(known.confidence > 0, known.inverse, known.lent)
    trust = np.maximum(known.confidence, np.where(sure, np.float32(0.35), np.float32(0)))
    values = np.where(sure, np.where(known.lent > 0, known.lent, evidence), np.float32(0))
    own_sure = sure & (known.confidence >= np.float32(0.3))
    values = np.where(own_sure, known.inverse, values).astype(np.float32)
    inverse = np.zeros((len(KINDS), *sure.shape), np.float32)
    weight = np.zeros_like(inverse)
    support = np.tile(np.arange(sure.size, dtype=np.int32).reshape(sure.shape), (len(KINDS), 1, 1))
    spoken = np.where(sure, values, evidence)
    votes = np.where(spoken > 0, trust, 0).astype(np.float64) ** _EVIDENCE_POWER
    filled, mass = _local_planes(spoken.astype(np.float64), votes, image)
    inverse[0], weight[0] = filled, np.minimum(1, np.log1p(1e3 * mass) / 8)
    inverse[1], weight[1] = known.inverse, known.confidence
    inverse[2], weight[2] = known.lent, np.minimum(known.mass / 4, 1)
    fade = np.float32(np.exp(-1 / (_FADE * max(sure.shape))))
    _walk_lines(values, fade, inverse, weight, support)
    _interpolate(inverse, support, weight)
    support[0] = _nearest(sure)
    _nearest_planes(values, planes, inverse[_PLANES:], weight[_PLANES:], support[_PLANES:])
    flat = [a.reshape(len(KINDS), -1)[:, pixels].T.copy() for a in (inverse, support, weight)]
    return Candidates(pixels, flat[0], flat[1].astype(np.int32), flat[2])


def _nearest(sure: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(h, w) flat index of the nearest sure pixel; 0 where there is none at all."""
    if not sure.any():
        return np.zeros(sure.shape, np.int32)
    _, label = cv2.distanceTransformWithLabels(
        (~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(label.max()) + 1, np.int32)
    place[label[sure]] = np.flatnonzero(sure)
    return np.asarray(place[label], np.int32)


@kernel
def _walk_lines(
    values: NDArray[np.float32],
    fade: np.float32,
    inverse: NDArray[np.float32],
    weight: NDArray[np.float32],
    support: NDArray[np.int32],
) -> None:
    """Along rows and columns both ways: the last sure value (kinds 3 to 6), and the line through those before it on the
    same surface (7 to 10)."""
    height, width = values.shape
    for way in range(4):
        upright = way >= 2
        lines, steps = (width, height) if upright else (height, width)
        for line in range(lines):
            n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
            last, place = 0.0, 0
            for step in range(steps):
                s = steps - 1 - step if way % 2 else step
                y, x = (s, line) if upright else (line, s)
                # Places are counted from the pixel where the walk is.
                sxx, sxy, sx = sxx - 2 * sx + n, sxy - sy, sx - n
                n, sx, sy, sxx, sxy = n * fade, sx * fade, sy * fade, sxx * fade, sxy * fade
                q = values[y, x]
                guess = 0.0
                if n > 0:
                    mx, my = sx / n, sy / n
                    slope = (sxy / n - mx * my) / (sxx / n - mx * mx + _FLAT)
                    guess = my - slope * mx
                if q > 0:
                    if n > 0 and abs(guess / q - 1) > _STEP:
                        n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
                    n, sy = n + 1, sy + q
                    last, place, guess = q, y * width + x, q
                if last > 0:
                    inverse[3 + way, y, x], inverse[7 + way, y, x] = last, max(guess, 0.0)
                    weight[3 + way, y, x] = weight[7 + way, y, x] = min(n / 10, 1.0)
                    support[3 + way, y, x] = support[7 + way, y, x] = place


def _interpolate(inverse: NDArray[np.float32], support: NDArray[np.int32], weight: NDArray[np.float32]) -> None:
    """Between the two sure values of a row (kind 11) and of a column (12), by distance."""
    height, width = inverse.shape[1:]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    for k, (first, second) in ((_ACROSS, (3, 4)), (_ACROSS + 1, (5, 6))):
        at, places = (x, support % width) if first == 3 else (y, support // width)
        before, after = np.abs(at - places[first]), np.abs(places[second] - at)
        both = (inverse[first] > 0) & (inverse[second] > 0)
        share = before / np.maximum(before + after, 1)
        inverse[k] = np.where(both, inverse[first] * (1 - share) + inverse[second] * share, 0)
        support[k] = np.where(before <= after, support[first], support[second])
        weight[k] = np.where(
            both, np.exp(-np.abs(np.log(np.maximum(inverse[first], 1e-9) / np.maximum(inverse[second], 1e-9)))), 0
        )


def _nearest_planes(
    values: NDArray[np.float32],
    planes: NDArray[np.float64],
    inverse: NDArray[np.float32],
    weight: NDArray[np.float32],
    support: NDArray[np.int32],
) -> None:
    """At each pixel the planes whose sure pixels are nearest."""
    height, width = values.shape
    if len(planes) == 0:
        return
    y, x = np.mgrid[:height, :width].astype(np.float32)
    all_of, far_of, at_of, share_of = [], [], [], []
    known = values > 0
    for a, b, c in planes.astype(np.float32):
        plane = a * x + b * y + c
        on = known & (np.abs(plane - values) < 1.5 * _ON * values)
        at = _nearest(on) if on.any() else np.arange(values.size, dtype=np.int32).reshape(values.shape)
        far = np.hypot(at % width - x, at // width - y) if on.any() else np.full(values.shape, 1e4)
        all_of.append(np.where(plane > 0, plane, 0))
        far_of.append(np.where(plane > 0, far, 1e5))
        at_of.append(at)
        share_of.append(min(1.0, 4 * on.mean()))
    far, plane, at = np.stack(far_of), np.stack(all_of), np.stack(at_of)
    count = min(len(inverse), len(planes))
    order = np.argsort(far, axis=0, kind="stable")[:count]
    inverse[:count] = np.take_along_axis(plane, order, 0)
    support[:count] = np.take_along_axis(at, order, 0)
    weight[:count] = np.array(share_of, np.float32)[order]


def find_planes(views: list[tuple[NDArray[np.float32], NDArray[np.float64]]], seed: int) -> NDArray[np.float64]:
    """Find the largest planes (N, 3) of what is sure in some views: of each its sure inverse depths (h, w) and the warp
    (3, 4) from its pixels to those of the first. Random hypotheses, largest first (RANSAC; Fischler, Bolles 1981)."""
    step = max(1, views[0][0].shape[1] // 80)
    points = [_lifted(inverse, warp, step) for inverse, warp in views]
    points = [p for p in points if len(p)]
    if not points:
        return np.zeros((0, 3))
    return np.asarray(_ransac(np.concatenate(points), _REACH * max(views[0][0].shape), seed))


def _lifted(inverse: NDArray[np.float32], warp: NDArray[np.float64], step: int) -> NDArray[np.float64]:
    """(P, 3) x, y and inverse depth in the first view of every so-manieth sure pixel."""
    y, x = np.nonzero(inverse[::step, ::step] > 0)
    y, x = y * step, x * step
    z = 1 / inverse[y, x].astype(np.float64)
    there = np.stack([(x + 0.5) * z, (y + 0.5) * z, z, np.ones(len(z))], -1) @ warp.T
    there = there[there[:, 2] > 1e-6 * z]
    return np.stack([there[:, 0] / there[:, 2] - 0.5, there[:, 1] / there[:, 2] - 0.5, 1 / there[:, 2]], -1)


@kernel
def _ransac(points: NDArray[np.float64], reach: float, seed: int) -> NDArray[np.float64]:
    """Of (P, 3) x, y, inverse depth; the planes' own points are taken away after each."""
    left, planes, found = np.arange(len(points)), np.zeros((_MOST_PLANES, 3)), 0
    state = np.array([seed * 2654435761 + 88172645463325252], np.uint64)
    while found < _MOST_PLANES and len(left) >= _LEAST_INLIERS:
        best, plane = 0, np.zeros(3)
        for _ in range(_HYPOTHESES):
            tried = _hypothesis(points, left, reach, state)
            inliers = 0
            for i in left:
                off = abs(tried[0] * points[i, 0] + tried[1] * points[i, 1] + tried[2] - points[i, 2])
                inliers += off < _ON * points[i, 2]
            if inliers > best:
                best, plane = inliers, tried
        if best < _LEAST_INLIERS:
            break
        for _ in range(2):
            plane = _refit(points, left, plane)
        planes[found] = plane
        found += 1
        off = np.abs(points[left, 0] * plane[0] + points[left, 1] * plane[1] + plane[2] - points[left, 2])
        stays = left[off >= _TAKEN * points[left, 2]]
        if len(stays) == len(left):
            break
        left = stays
    return planes[:found]


@kernel
def _drawn(state: NDArray[np.uint64], below: int) -> int:
    """A number in [0, below), by the xorshift generator."""
    s = state[0]
    s ^= s << np.uint64(13)
    s ^= s >> np.uint64(7)
    s ^= s << np.uint64(17)
    state[0] = s
    return np.int64(s % np.uint64(below))


@kernel
def _hypothesis(
    points: NDArray[np.float64], left: NDArray[np.int64], reach: float, state: NDArray[np.uint64]
) -> NDArray[np.float64]:
    """The plane (3,) through three points near each other; zeros where there are none or they lie on a line."""
    first = _drawn(state, len(left))
    rows = np.full(3, left[first])
    for k in range(1, 3):
        for _ in range(12):
            # The points of a view follow each other by rows: those nearby are near in the list too.
            rows[k] = left[min(max(first + _drawn(state, 2 * _AROUND) - _AROUND, 0), len(left) - 1)]
            dx, dy = points[rows[k], 0] - points[rows[0], 0], points[rows[k], 1] - points[rows[0], 1]
            if 4 < dx * dx + dy * dy < reach * reach:
                break
    a, b, c = points[rows[0]], points[rows[1]], points[rows[2]]
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if abs(area) < 4:
        return np.zeros(3)
    px = ((b[2] - a[2]) * (c[1] - a[1]) - (c[2] - a[2]) * (b[1] - a[1])) / area
    py = ((b[0] - a[0]) * (c[2] - a[2]) - (c[0] - a[0]) * (b[2] - a[2])) / area
    return np.array([px, py, a[2] - px * a[0] - py * a[1]])


@kernel
def _refit(points: NDArray[np.float64], left: NDArray[np.int64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares of the relative error over what lies on the plane."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for i in left:
        x, y, q = points[i, 0], points[i, 1], points[i, 2]
        if abs(plane[0] * x + plane[1] * y + plane[2] - q) < _ON * q:
            row = np.array([x / q, y / q, 1 / q])
            for a in range(3):
                right[a] += row[a]
                for b in range(3):
                    matrix[a, b] += row[a] * row[b]
    for a in range(3):
        matrix[a, a] *= 1 + 1e-9
    return np.linalg.solve(matrix, right)
