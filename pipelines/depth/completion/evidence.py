"""Depths that a pixel could have, and evidence for and against each: its support, and other keyframes."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...system.jit import kernel
from .fill import SURE, agreed_depth, carry_depth, local_planes

Array = NDArray[np.float32]
Bytes = NDArray[np.uint8]
KINDS = (
    "fill", "own", "lent", "left", "right", "above", "below", "left line", "right line", "above line", "below line",
    "own around",
)  # fmt: skip
_EVIDENCE_POWER = 2.5
LENT_CONFIDENCE = np.float32(0.35)
"""Of what others lend."""
_FADE = 0.04
"""Of the image's longer side: over this length a sure depth's say in the line through it fades."""
_STEP = 0.04
"""Relative difference to the line at which another surface begins."""
_FLAT = 6.0
"""Squared pixels added to the spread of places: short lines are kept flat."""
OF_CANDIDATE, OF_PLACE = 13, 6
FEATURES = OF_CANDIDATE + OF_PLACE
"""Numbers that are known of each candidate of a pixel, and of the pixel."""
LEAST_NUMBER, _NOTHING = -0.75, 68
STEP_OF_NUMBERS = -LEAST_NUMBER / _NOTHING
"""They are kept as bytes: the value of 0, the byte that stands for a value of 0, and what one more is worth."""
_SAME = np.float32(0.004)
"""Candidates whose depths differ by less, relatively, are asked about once."""
LENDERS, ASKED = 16, 6
"""Keyframes that lend sure depths; the nearest of them say whether a candidate can be."""
_LEAST_PIXELS = 40
_LEAST = 0.5
"""Likeness of colour that the agreeing views must have together; a view of the same colour counts 1. By the depth of
six rooms' proxies 1.0 is 1 to 4 % worse on three and 0.2 % better on three; of three, 0.25 is 1 % worse on two."""


@dataclass(frozen=True)
class HalfResKeyframe:
    """A keyframe at half the size: inverse depth (0: none) and confidence (h, w) of the surest of four pixels, picture
    (h, w, 3) as RGB and in CIE Lab, and contrast as of `surface_contrast` (h, w)."""

    inverse: Array
    confidence: Array
    image: NDArray[np.uint8]
    lab: Array
    contrast: Array


def invert(values: Array) -> Array:
    """1 / values, and 0 stays 0: depth from inverse depth and back."""
    out = np.zeros_like(values)
    np.divide(1, values, out=out, where=values > 0)
    return out


@dataclass(frozen=True)
class Candidates:
    """Depths that P pixels (flat indices) could have, inverse (P, K), 0 where a kind says nothing; flat index of the
    sure pixel that speaks (P, K), the pixel itself where there is none; how much there is behind it (P, K)."""

    pixels: NDArray[np.int64]
    inverse: Array
    support: NDArray[np.int32]
    weight: Array


def find_candidates(
    own: HalfResKeyframe, lent: Array, mass: Array, sure: NDArray[np.bool_], pixels: NDArray[np.int64]
) -> Candidates:
    """List what `pixels` (P,) of a keyframe that are not `sure` (h, w) could have, from those that are, by their own
    match or by the inverse depths lent by others (h, w), who agree as much as `mass` (h, w) says."""
    known_inverse_depth = np.where(sure & (own.confidence < SURE) | (own.confidence <= 0), lent, own.inverse)
    values = np.where(sure, known_inverse_depth, np.float32(0)).astype(np.float32)
    inverse = np.zeros((len(KINDS), *sure.shape), np.float32)
    weight = np.zeros_like(inverse)
    support = np.tile(np.arange(sure.size, dtype=np.int32).reshape(sure.shape), (len(KINDS), 1, 1))
    trust = np.maximum(own.confidence, np.where(sure, LENT_CONFIDENCE, np.float32(0)))
    votes = np.where(known_inverse_depth > 0, trust, 0).astype(np.float64) ** _EVIDENCE_POWER
    inverse[0], votes_there = local_planes(known_inverse_depth.astype(np.float64), votes, own.image)
    weight[0], support[0] = np.minimum(1, np.log1p(1e3 * votes_there) / 8), _nearest(sure)
    inverse[1], weight[1] = own.inverse, own.confidence
    inverse[2], weight[2] = lent, np.minimum(mass / 4, 1)
    inverse[11], weight[11] = cv2.medianBlur(own.inverse, 5), cv2.medianBlur(own.confidence, 5)
    fade = math.exp(-1 / (_FADE * max(sure.shape)))
    _walk_lines(values, fade, inverse, weight, support)
    at = [np.ascontiguousarray(a.reshape(len(KINDS), -1)[:, pixels].T) for a in (inverse, weight)]
    return Candidates(pixels, at[0], np.ascontiguousarray(support.reshape(len(KINDS), -1)[:, pixels].T), at[1])


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


def find_speakers(sure: NDArray[np.bool_], lab: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose those of the U pixels that are not sure (h, w) for which candidates are weighed, flat indices (P,), and
    who of them speaks for each of all (U,): half of them, as the fields of a chessboard, each for itself and for those
    beside it whose colour (h, w, 3) is more like its own than the others' around them."""
    speaker = np.empty(sure.shape, np.int64)
    _point_to_speakers(sure, lab, speaker)
    chosen, number = np.unique(speaker[~sure], return_inverse=True)
    return chosen, number.reshape(-1)


@kernel
def _point_to_speakers(sure: NDArray[np.bool_], lab: Array, speaker: NDArray[np.int64]) -> None:
    height, width = sure.shape
    for y in range(height):
        for x in range(width):
            speaker[y, x], least = y * width + x, np.inf
            for way in range(4 * ((y + x) % 2)):
                row, column = y + (way == 0) - (way == 1), x + (way == 2) - (way == 3)
                if 0 <= row < height and 0 <= column < width and not sure[row, column]:
                    apart = 0.0
                    for c in range(3):
                        apart += (lab[row, column, c] - lab[y, x, c]) ** 2
                    if apart < least:
                        speaker[y, x], least = row * width + column, apart


@kernel
def _walk_lines(
    values: Array,
    fade: float,
    inverse: Array,
    weight: Array,
    support: NDArray[np.int32],
) -> None:
    """Along rows and columns both ways: the last sure value (kinds 3 to 6), the line through those before (7 to 10)."""
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
                    last, place, guess = float(q), y * width + x, float(q)
                if last > 0:
                    inverse[3 + way, y, x], inverse[7 + way, y, x] = last, max(guess, 0.0)
                    weight[3 + way, y, x] = weight[7 + way, y, x] = min(n / 10, 1.0)
                    support[3 + way, y, x] = support[7 + way, y, x] = place


@dataclass(frozen=True)
class CompletionInputs:
    """Basis of a completion: what a keyframe is `sure` of (h, w), by its own match or by inverse depths that are lent
    (h, w); of P other `pixels` (flat indices), inverse depths of candidates (P, K) and evidence for them (P, K, F), and
    what is known of each place (P, G); and which of them speaks for each of all U pixels that are not sure (U,)."""

    own: HalfResKeyframe
    lent: Array
    sure: NDArray[np.bool_]
    pixels: NDArray[np.int64]
    inverse: Array
    evidence: Bytes
    place: Bytes
    speaker: NDArray[np.int64]

    @property
    def from_other_views(self) -> NDArray[np.bool_]:
        """(h, w) where others are sure and the keyframe is not."""
        return self.sure & (self.own.confidence < SURE)

    @property
    def unsure(self) -> NDArray[np.int64]:
        """(U,) flat indices of the pixels that are not sure."""
        return np.flatnonzero(~self.sure)

    @property
    def known_inverse_depth(self) -> Array:
        """(h, w) inverse depth where it is sure, own or borrowed; 0 elsewhere."""
        return np.where(self.from_other_views | (self.own.confidence <= 0), self.lent, self.own.inverse) * self.sure


def build_inputs(
    own: HalfResKeyframe,
    lenders: list[HalfResKeyframe],
    lent: list[NDArray[np.float64]],
    asked: list[NDArray[np.float64]],
    all_speak: bool = False,
) -> CompletionInputs | None:
    """Gather all that the completion of a keyframe rests on; None with hardly any sure pixel.

    `lent` (3, 4) lead from the lenders' pixels to the keyframe's, `asked` back from it to those of the first of them.
    Candidates are of the pixels that speak for the others, or of all that are not sure.
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
    unknown = np.flatnonzero(~sure)
    pixels, speaker = (unknown, np.arange(len(unknown))) if all_speak else find_speakers(sure, own.lab)
    found = find_candidates(own, borrowed, mass, sure, pixels)
    evidence = np.empty((*found.inverse.shape, OF_CANDIDATE), np.uint8)
    _weigh_support(found.pixels, found.support, found.weight, own.lab, evidence)
    places = _describe_places(found.pixels, own, mass, sure)
    inputs = CompletionInputs(own, borrowed, sure, found.pixels, found.inverse, evidence, places, speaker)
    return update_view_evidence(inputs, lenders[:ASKED], asked)


def update_view_evidence(
    inputs: CompletionInputs, views: list[HalfResKeyframe], warps: list[NDArray[np.float64]]
) -> CompletionInputs:
    """Return the inputs with what the views say of its candidates, nothing where there are none; warps (3, 4) lead from
    the keyframe's pixels to theirs."""
    evidence, own = inputs.evidence.copy(), inputs.own
    if views:
        _ask_views(inputs.pixels, inputs.inverse, own.lab, *_stacked(views), np.stack(warps), evidence)
    else:
        evidence[..., 3:] = _NOTHING
    return replace(inputs, evidence=evidence)


def _stacked(views: list[HalfResKeyframe]) -> tuple[Array, Array, Array]:
    inverse, confidence, lab = ([getattr(v, name) for v in views] for name in ("inverse", "confidence", "lab"))
    return np.stack(inverse), np.stack(confidence), np.stack(lab)


def _describe_places(pixels: NDArray[np.int64], own: HalfResKeyframe, mass: Array, sure: NDArray[np.bool_]) -> Bytes:
    """Return (P, OF_PLACE) for flat indices (P,); mass and sure (h, w) as of `find_candidates`."""
    far = cv2.distanceTransform((~sure).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    around = np.maximum(cv2.medianBlur(own.inverse, 5), 1e-9)
    away = np.minimum(np.abs(np.log(np.maximum(own.inverse, 1e-9) / around)), np.float32(0.5))
    numbers = (
        own.confidence, np.minimum(mass / 4, 1), np.log1p(far) / 5, np.log10(own.contrast + 1e-7) / 4 + 1,
        np.sqrt(cv2.blur(away, (7, 7))), cv2.blur((own.inverse > 0).astype(np.float32), (7, 7)),
    )  # fmt: skip
    at = np.stack([values.ravel()[pixels] for values in numbers], -1)
    return np.clip(np.rint((at - LEAST_NUMBER) / STEP_OF_NUMBERS), 0, 255).astype(np.uint8)


@kernel
def _as_byte(value: float) -> int:
    return int(min(max(np.rint((value - LEAST_NUMBER) / STEP_OF_NUMBERS), 0.0), 255.0))


@kernel
def _weigh_support(
    pixels: NDArray[np.int64], support: NDArray[np.int32], weight: Array, lab: Array, out: Bytes
) -> None:
    """Features 0 to 2: distance to the supporting pixel, difference of its colour, and its weight."""
    width = lab.shape[1]
    for p in range(len(pixels)):
        y, x = pixels[p] // width, pixels[p] % width
        for k in range(support.shape[1]):
            sy, sx = support[p, k] // width, support[p, k] % width
            apart = 0.0
            for c in range(3):
                apart += (lab[sy, sx, c] - lab[y, x, c]) ** 2
            out[p, k, 0] = _as_byte(np.log1p(np.sqrt(float((sy - y) ** 2 + (sx - x) ** 2))) / 5)
            out[p, k, 1] = _as_byte(min(np.sqrt(apart) / 30, 2.0))
            out[p, k, 2] = _as_byte(weight[p, k])


@kernel
def _ask_views(
    pixels: NDArray[np.int64],
    inverse: Array,
    lab: Array,
    seen: Array,
    trust: Array,
    colors: Array,
    warps: NDArray[np.float64],
    out: Bytes,
) -> None:
    """Features 3 to 12: shares of views that see the depth on, before or behind theirs, and colours there."""
    # One function, whose sums are numbers and no arrays: at a quarter of the time.
    views, height, width = seen.shape
    ray = np.zeros((views, 3))
    for p in range(len(pixels)):
        y, x = pixels[p] // width, pixels[p] % width
        for v in range(views):
            for i in range(3):
                ray[v, i] = warps[v, i, 0] * (x + 0.5) + warps[v, i, 1] * (y + 0.5) + warps[v, i, 2]
        for k in range(inverse.shape[1]):
            alike, w = _earlier(inverse, p, k), np.float64(inverse[p, k])
            if w <= 0 or alike >= 0:
                for n in range(3, OF_CANDIDATE):
                    out[p, k, n] = out[p, alike, n] if alike >= 0 else 0
                continue
            on, through, behind, weakly_on, weakly_through = 0.0, 0.0, 0.0, 0.0, 0.0
            inside, shown, summed, least = 0.0, 0.0, 0.0, 2.0
            for v in range(views):
                qz = ray[v, 2] + w * warps[v, 2, 3]  # the depth there over that here
                if qz <= 1e-6:
                    continue
                qx, qy = (ray[v, 0] + w * warps[v, 0, 3]) / qz - 0.5, (ray[v, 1] + w * warps[v, 1, 3]) / qz - 0.5
                left, top = int(np.floor(qx)), int(np.floor(qy))
                if left < 0 or top < 0 or left + 1 >= width or top + 1 >= height:
                    continue
                inside += 1
                fx, fy, apart = qx - left, qy - top, 0.0
                there = seen[v, top + (fy >= 0.5), left + (fx >= 0.5)]
                ratio = qz * there / w  # of the depths
                if there > 0 and trust[v, top + (fy >= 0.5), left + (fx >= 0.5)] >= SURE:
                    on += abs(ratio - 1) < 0.02
                    through += ratio < 0.97
                    if ratio > 1.03:
                        behind += 1
                        continue
                elif there > 0:
                    weakly_on += abs(ratio - 1) < 0.02
                    weakly_through += ratio < 0.95
                for c in range(3):
                    above = colors[v, top, left, c] * (1 - fx) + colors[v, top, left + 1, c] * fx
                    below = colors[v, top + 1, left, c] * (1 - fx) + colors[v, top + 1, left + 1, c] * fx
                    step = above * (1 - fy) + below * fy - lab[y, x, c]
                    apart += step * step * (0.5 if c == 0 else 1.0)
                apart = min(np.sqrt(apart) / 20, 2.0)
                shown, summed, least = shown + 1, summed + apart, min(least, apart)
            total = max(inside, 1.0)
            numbers = (
                on / total, through / total, behind / total, weakly_on / total, weakly_through / total, inside / views,
                shown / total, summed / shown if shown > 0 else 1.0, least, min(on, 3.0) / 3,
            )  # fmt: skip
            for n in range(len(numbers)):
                out[p, k, 3 + n] = _as_byte(numbers[n])


@kernel
def _earlier(inverse: Array, p: int, k: int) -> int:
    """An earlier candidate of a pixel that is as good as the same depth; -1 where there is none."""
    for m in range(k):
        if abs(inverse[p, m] - inverse[p, k]) < _SAME * inverse[p, k]:
            return m
    return -1
