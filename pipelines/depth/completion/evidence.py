"""Evidence for and against each candidate depth of a pixel: its support, and other keyframes."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel
from .candidates import Array, Candidates, Half, find_candidates, invert
from .fill import SURE, agreed_depth, carry_depth

FEATURES = 19
_SAME = np.float32(0.004)
"""Candidates whose depths differ by less, relatively, are asked about once."""
LENDERS, ASKED = 16, 6
"""Keyframes that lend sure depths; the nearest of them say whether a candidate can be."""
_LEAST_PIXELS = 40
_LEAST = 0.5
"""Likeness of colour that the agreeing views must have together; a view of the same colour counts 1. By the depth of
six rooms' proxies 1.0 is 1 to 4 % worse on three and 0.2 % better on three; of three, 0.25 is 1 % worse on two."""


@dataclass(frozen=True)
class Case:
    """Basis of a completion: candidates and evidence (P, K, F) of the pixels that are not `sure` (h, w), by their
    own match or by inverse depths that are lent (h, w)."""

    own: Half
    lent: Array
    sure: NDArray[np.bool_]
    found: Candidates
    evidence: NDArray[np.float16]

    @property
    def borrowed(self) -> NDArray[np.bool_]:
        """(h, w) where others are sure and the keyframe is not."""
        return self.sure & (self.own.confidence < SURE)

    @property
    def spoken(self) -> Array:
        """(h, w) inverse depth where it is sure, own or borrowed; 0 elsewhere."""
        return np.where(self.borrowed | (self.own.confidence <= 0), self.lent, self.own.inverse) * self.sure


def gather_case(
    own: Half, lenders: list[Half], lent: list[NDArray[np.float64]], asked: list[NDArray[np.float64]]
) -> Case | None:
    """Gather all that the completion of a keyframe rests on; None with hardly any sure pixel.

    `lent` (3, 4) lead from the lenders' pixels to the keyframe's, `asked` back from it to those of the first of them.
    """
    unsure = own.confidence < SURE
    if (~unsure).sum() < _LEAST_PIXELS:
        return None
    carried = [
        carry_depth(invert(h.inverse), h.confidence, h.lab, warp, own.lab)
        for h, warp in zip(lenders, lent, strict=True)
    ]
    depth, mass = agreed_depth(carried, unsure) if carried else (np.zeros_like(own.inverse),) * 2
    borrowed, sure = invert(depth), ~unsure | (mass > _LEAST)
    found = find_candidates(own, borrowed, mass, sure)
    evidence = _gather_evidence(found, own, mass, sure, lenders[:ASKED], asked)
    return Case(own, borrowed, sure, found, evidence.astype(np.float16))


def ask_again(case: Case, views: list[Half], warps: list[NDArray[np.float64]]) -> Case:
    """Return the case with what the views say now that they are completed themselves."""
    if not views:
        return case
    evidence = case.evidence.astype(np.float32)
    _ask_views(case.found.pixels, case.found.inverse, case.own.lab, *_stacked(views), np.stack(warps), evidence)
    return replace(case, evidence=evidence.astype(np.float16))


def _stacked(views: list[Half]) -> tuple[Array, Array, Array]:
    inverse, confidence, lab = ([getattr(v, name) for v in views] for name in ("inverse", "confidence", "lab"))
    return np.stack(inverse), np.stack(confidence), np.stack(lab)


def _gather_evidence(
    found: Candidates,
    own: Half,
    mass: Array,
    sure: NDArray[np.bool_],
    views: list[Half],
    warps: list[NDArray[np.float64]],
) -> Array:
    """Return (P, K, FEATURES) numbers, zeros for a kind that says nothing; mass and sure (h, w) as of
    `find_candidates`, the warps (3, 4) lead from the pixels of the keyframe to those of the views."""
    lab = own.lab
    out = np.zeros((*found.inverse.shape, FEATURES), np.float32)
    y, x = np.divmod(found.pixels, sure.shape[1])
    sy, sx = np.divmod(found.support, sure.shape[1])
    out[..., 0] = np.log1p(np.hypot(sy - y[:, None], sx - x[:, None])) / 5
    out[..., 1] = np.minimum(np.linalg.norm(lab[sy, sx] - lab[y, x][:, None], axis=-1) / 30, 2)
    out[..., 2] = found.weight
    if views:
        _ask_views(found.pixels, found.inverse, lab, *_stacked(views), np.stack(warps), out)
    far = cv2.distanceTransform((~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    around = np.maximum(cv2.medianBlur(own.inverse, 5), 1e-9)
    away = np.minimum(np.abs(np.log(np.maximum(own.inverse, 1e-9) / around)), np.float32(0.5))
    of_pixel = (
        own.confidence, np.minimum(mass / 4, 1), np.log1p(far) / 5, np.log10(own.contrast + 1e-7) / 4 + 1,
        np.sqrt(cv2.blur(away, (7, 7))), cv2.blur((own.inverse > 0).astype(np.float32), (7, 7)),
    )  # fmt: skip
    for k, values in enumerate(of_pixel, FEATURES - len(of_pixel)):
        out[..., k] = values[y, x][:, None]
    out[found.inverse <= 0] = 0
    return out


@kernel
def _ask_views(
    pixels: NDArray[np.int64],
    inverse: Array,
    lab: Array,
    seen: Array,
    trust: Array,
    colors: Array,
    warps: NDArray[np.float64],
    out: Array,
) -> None:
    """Features 3 to 12: in how many views the candidate is on, in front of and behind what they surely see there, on
    and in front of what they matched unsurely, seen at all; how much the colours differ there."""
    views, width, votes = len(seen), seen.shape[2], np.zeros(9)
    for p in range(len(pixels)):
        y, x = pixels[p] // width, pixels[p] % width
        for k in range(inverse.shape[1]):
            if inverse[p, k] <= 0:
                continue
            alike = _earlier(inverse[p], k)
            if alike >= 0:
                out[p, k, 3:13] = out[p, alike, 3:13]
                continue
            votes[:] = 0
            votes[8] = 2.0
            for v in range(views):
                _vote(y, x, 1 / np.float64(inverse[p, k]), lab[y, x], seen[v], trust[v], colors[v], warps[v], votes)
            inside, shown = max(votes[5], 1.0), votes[6]
            for n in range(5):  # on, through, behind, weakly on, weakly through
                out[p, k, 3 + n] = votes[n] / inside
            out[p, k, 8], out[p, k, 9] = votes[5] / views, shown / inside
            out[p, k, 10], out[p, k, 11] = votes[7] / shown if shown > 0 else 1.0, votes[8]
            out[p, k, 12] = min(votes[0], 3.0) / 3


@kernel
def _earlier(inverse: Array, k: int) -> int:
    """An earlier candidate that is as good as the same depth; -1 where there is none."""
    for m in range(k):
        if abs(inverse[m] - inverse[k]) < _SAME * inverse[k]:
            return m
    return -1


@kernel
def _vote(
    y: int,
    x: int,
    z: float,
    color: Array,
    seen: Array,
    trust: Array,
    colors: Array,
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
