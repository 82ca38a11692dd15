"""What speaks for and against each candidate depth of a pixel: other candidates, its support, other keyframes."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.fill import SURE
from msgs_slam.pipelines.system.jit import kernel

from .candidates import Candidates, Known

FEATURES = 37
_SAMPLES = 10
"""Places between a pixel and its support at which edges are looked for."""


@dataclass(frozen=True)
class View:
    """Another keyframe: inverse depth and confidence of its match (h, w), its colours (h, w, 3) in CIE Lab, and the
    warp (3, 4) from the pixels of the first keyframe to its own."""

    inverse: NDArray[np.float32]
    confidence: NDArray[np.float32]
    lab: NDArray[np.float32]
    warp: NDArray[np.float64]


def gather_evidence(
    found: Candidates, known: Known, sure: NDArray[np.bool_], lab: NDArray[np.float32], views: list[View]
) -> NDArray[np.float32]:
    """(P, K, FEATURES), zeros for a kind that says nothing; lab (h, w, 3)."""
    out = np.zeros((*found.inverse.shape, FEATURES), np.float32)
    gradient = np.sqrt(sum((cv2.Sobel(lab, cv2.CV_32F, *way) ** 2).sum(-1) for way in ((1, 0), (0, 1))))
    _compare(found.inverse, out)
    given = found.pixels, found.inverse, found.support, found.weight
    _look_along(*given, lab, gradient, known.confidence, out)
    if views:
        stacks = [np.stack([getattr(v, name) for v in views]) for name in ("inverse", "confidence", "lab", "warp")]
        _ask_views(found.pixels, found.inverse, lab, *stacks, out)
    far = cv2.distanceTransform((~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    height, width = sure.shape
    y, x = np.divmod(found.pixels, width)
    around = cv2.GaussianBlur(gradient, (0, 0), 3)
    pixel = [
        known.confidence[y, x], np.minimum(known.mass[y, x] / 4, 1), np.log1p(far[y, x]) / 5, y / height - 0.5,
        np.abs(x / width - 0.5), lab[y, x, 0] / 100 - 0.5, np.minimum(around[y, x] / 100, 2),
        np.full(len(y), (~sure).mean()),
    ]  # fmt: skip
    for k, values in enumerate(pixel):
        out[:, :, FEATURES - len(pixel) + k] = values[:, None]
    out[found.inverse <= 0] = 0
    return out


@kernel
def _compare(inverse: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Features 0 to 8: how the candidate stands to the fill, the match, the median, and how many stand beside it."""
    count = inverse.shape[1]
    logs, order = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for p in range(len(inverse)):
        known = 0
        for k in range(count):
            if inverse[p, k] > 0:
                logs[k] = np.log(inverse[p, k])
                order[known] = logs[k]
                known += 1
        if known == 0:
            continue
        middle = np.sort(order[:known])[known // 2]
        for k in range(count):
            if inverse[p, k] <= 0:
                continue
            at = logs[k]
            for n in range(3):
                if n == 2 or inverse[p, n] > 0:
                    other = middle if n == 2 else logs[n]
                    off = min(max(at - other, np.float32(-1)), np.float32(1))
                    out[p, k, n] = off
                    out[p, k, 3 + n] = np.sqrt(abs(off))
            for m in range(count):
                if m != k and inverse[p, m] > 0:
                    off = abs(at - logs[m])
                    out[p, k, 6] += np.exp(-off * 100) * np.float32(0.2)
                    out[p, k, 7] += np.exp(-off * 30) * np.float32(0.2)
                    out[p, k, 8] += np.exp(-off * 10) * np.float32(0.2)


@kernel
def _look_along(
    pixels: NDArray[np.int64],
    inverse: NDArray[np.float32],
    support: NDArray[np.int32],
    weight: NDArray[np.float32],
    lab: NDArray[np.float32],
    gradient: NDArray[np.float32],
    confidence: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Features 9 to 15: distance to the support, its colour, the edges in between, how sure it is."""
    width = gradient.shape[1]
    for p in range(len(pixels)):
        y, x = pixels[p] // width, pixels[p] % width
        for k in range(inverse.shape[1]):
            if inverse[p, k] <= 0:
                continue
            sy, sx = support[p, k] // width, support[p, k] % width
            far = np.sqrt(np.float64((sy - y) ** 2 + (sx - x) ** 2))
            color, light = 0.0, 0.0
            for c in range(3):
                step = np.float64(lab[sy, sx, c] - lab[y, x, c])
                color += step * step
            light = abs(np.float64(lab[sy, sx, 0] - lab[y, x, 0]))
            most, total = 0.0, 0.0
            for s in range(_SAMPLES):
                t = (s + 0.5) / _SAMPLES
                edge = np.float64(gradient[int(y + (sy - y) * t + 0.5), int(x + (sx - x) * t + 0.5)])
                most, total = max(most, edge), total + edge
            out[p, k, 9] = np.log1p(far) / 5
            out[p, k, 10] = min(np.sqrt(color) / 30, 2.0)
            out[p, k, 11] = min(light / 30, 2.0)
            out[p, k, 12] = min(np.sqrt(most) / 15, 2.0)
            out[p, k, 13] = min(np.sqrt(total / _SAMPLES) / 10, 2.0)
            out[p, k, 14] = confidence[sy, sx]
            out[p, k, 15] = weight[p, k]


@kernel
def _ask_views(
    pixels: NDArray[np.int64],
    inverse: NDArray[np.float32],
    lab: NDArray[np.float32],
    seen: NDArray[np.float32],
    trust: NDArray[np.float32],
    colors: NDArray[np.float32],
    warps: NDArray[np.float64],
    out: NDArray[np.float32],
) -> None:
    """Features 16 to 28: in how many views the candidate is on, in front of and behind what they surely see there, on
    what they matched unsurely, seen at all; how much the colours differ there; all that beside the best candidate."""
    views, width, count = len(seen), seen.shape[2], inverse.shape[1]
    votes = np.zeros(9)
    for p in range(len(pixels)):
        y, x = pixels[p] // width, pixels[p] % width
        least_color, least_through, most_on = np.float32(9), np.float32(9), np.float32(0)
        for k in range(count):
            if inverse[p, k] <= 0:
                continue
            votes[:] = 0
            votes[8] = 2.0
            for v in range(views):
                _vote(y, x, 1 / np.float64(inverse[p, k]), lab[y, x], seen[v], trust[v], colors[v], warps[v], votes)
            inside, shown = max(votes[5], 1.0), votes[6]
            for n in range(5):  # on, through, behind, weakly on, weakly through
                out[p, k, 16 + n] = votes[n] / inside
            out[p, k, 21], out[p, k, 22] = votes[5] / views, shown / inside
            out[p, k, 23], out[p, k, 24] = votes[7] / shown if shown > 0 else 1.0, votes[8]
            out[p, k, 25] = min(votes[0], 3.0) / 3
            least_color, most_on = min(least_color, out[p, k, 23]), max(most_on, out[p, k, 16])
            least_through = min(least_through, out[p, k, 17])
        for k in range(count):
            if inverse[p, k] > 0:
                out[p, k, 26] = out[p, k, 23] - least_color
                out[p, k, 27] = out[p, k, 17] - least_through
                out[p, k, 28] = out[p, k, 16] - most_on


@kernel
def _vote(
    y: int,
    x: int,
    z: float,
    color: NDArray[np.float32],
    seen: NDArray[np.float32],
    trust: NDArray[np.float32],
    colors: NDArray[np.float32],
    warp: NDArray[np.float64],
    votes: NDArray[np.float64],
) -> None:
    """Add what one view says of depth z at a pixel: on, through, behind, weakly on, weakly through what it has there,
    inside of it, not hidden, difference of colour; and lessen the least difference of colour."""
    height, width = seen.shape
    u, v = x + 0.5, y + 0.5
    qz = z * (warp[2, 0] * u + warp[2, 1] * v + warp[2, 2]) + warp[2, 3]
    if qz <= 1e-6 * z:
        return
    qx = (z * (warp[0, 0] * u + warp[0, 1] * v + warp[0, 2]) + warp[0, 3]) / qz - 0.5
    qy = (z * (warp[1, 0] * u + warp[1, 1] * v + warp[1, 2]) + warp[1, 3]) / qz - 0.5
    left, top = int(np.floor(qx)), int(np.floor(qy))
    if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
        return
    votes[5] += 1
    near_y, near_x = int(np.floor(qy + 0.5)), int(np.floor(qx + 0.5))
    if seen[near_y, near_x] > 0:
        ratio = qz * seen[near_y, near_x]  # of the depths
        if trust[near_y, near_x] >= SURE:
            votes[0] += abs(ratio - 1) < 0.02
            votes[1] += ratio < 0.97
            if ratio > 1.03:
                votes[2] += 1
                return
        else:
            votes[3] += abs(ratio - 1) < 0.02
            votes[4] += ratio < 0.95
    fx, fy, apart = qx - left, qy - top, 0.0
    for c in range(3):
        above = colors[top, left, c] * (1 - fx) + colors[top, left + 1, c] * fx
        below = colors[top + 1, left, c] * (1 - fx) + colors[top + 1, left + 1, c] * fx
        step = above * (1 - fy) + below * fy - color[c]
        apart += step * step * (0.5 if c == 0 else 1.0)
    apart = min(np.sqrt(apart) / 20, 2.0)
    votes[6] += 1
    votes[7] += apart
    votes[8] = min(votes[8], apart)
