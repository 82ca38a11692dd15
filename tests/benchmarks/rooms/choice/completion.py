"""A keyframe's depth completed where its views do not agree: at half the size, a choice among candidates.

What a view shows at its rim, or too blank from where it stands, others may see better: their sure depths are borrowed
where both show the same colour. Elsewhere candidates are weighed by a model that learned from made rooms.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.fill import SURE, agreed_depth, carry_depth
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth, invert
from msgs_slam.pipelines.depth.stereo.upsample import upsample_depth
from msgs_slam.pipelines.geometry.voxels import to_lab
from msgs_slam.pipelines.providers import DepthEstimate, resize_area
from msgs_slam.pipelines.system.parallel import LruCache

from .candidates import LENT_CONFIDENCE, Array, Candidates, Half, find_candidates
from .evidence import gather_evidence
from .model import ChoiceModel, choose

LENDERS = 16
"""Keyframes that lend sure depths."""
_ASKED = 6
"""The nearest of them say whether a candidate can be."""
_LEAST_PIXELS = 40
_LEAST = 0.5
"""Likeness of colour that the agreeing views must have together; a view of the same colour counts 1. By the depth of
six rooms' proxies 1.0 is 1 to 4 % worse on three and 0.2 % better on three; of three, 0.25 is 1 % worse on two."""
_MOST_CONFIDENCE, _FADING = 0.25, 0.05
"""Of a chosen depth, and the expected error in log depth at which a part of 1 / e is left."""


_HALF, _TWICE = np.diag([0.5, 0.5, 1]), np.diag([2.0, 2, 1, 1])
"""Bring a warp between pictures to half their size."""


@dataclass(frozen=True)
class Case:
    """Basis of the choice: candidates and evidence (P, K, F) of the pixels that are not `sure` (h, w), by their
    own match or by inverse depths that are lent (h, w)."""

    own: Half
    lent: Array
    sure: NDArray[np.bool_]
    found: Candidates
    evidence: Array


def halved(depth: Array, confidence: Array, image: NDArray[np.uint8], contrast: Array) -> Half:
    """Reduce depth, confidence and contrast (H, W) to the size of the picture (H/2, W/2, 3), both rounded up."""
    height, width = image.shape[:2]
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = []
    for values in (depth, np.where(depth > 0, confidence, 0)):
        whole = np.pad(values, pad, mode="edge").reshape(height, 2, width, 2)
        blocks.append(whole.transpose(0, 2, 1, 3).reshape(height, width, 4))
    best = blocks[1].argmax(-1)[..., None]
    found, sure = (np.take_along_axis(b, best, -1)[..., 0] for b in blocks)
    small = np.asarray(cv2.resize(contrast, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    return Half(invert(found), sure.astype(np.float32), image, to_lab(image), small)


def consider(
    own: Half, lenders: list[Half], lent: list[NDArray[np.float64]], asked: list[NDArray[np.float64]]
) -> Case | None:
    """Gather all that the choice rests on; None with hardly any sure pixel.

    `lent` (3, 4) lead from the lenders' pixels to the keyframe's, `asked` back from it to theirs.
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
    evidence = gather_evidence(found, own, mass, sure, lenders[:_ASKED], asked[:_ASKED])
    return Case(own, borrowed, sure, found, evidence)


def complete(case: Case, model: ChoiceModel) -> tuple[Array, Array]:
    """Return depth and confidence (h, w) at half the size: borrowed or chosen where the own match is not sure."""
    borrowed = case.sure & (case.own.confidence < SURE)
    inverse = np.where(borrowed, case.lent, case.own.inverse)
    confidence = np.where(borrowed, LENT_CONFIDENCE, case.own.confidence)
    chosen, risk = choose(case.found.inverse, model.judge(case.evidence))
    inverse.ravel()[case.found.pixels] = chosen
    confidence.ravel()[case.found.pixels] = _MOST_CONFIDENCE * np.exp(-risk / _FADING)
    return invert(inverse), confidence


class Completion:
    """The completion of a provider's keyframes, in place of its own."""

    def __init__(self, provider: MultiviewDepth, model: ChoiceModel | None = None) -> None:
        """Without a model there are only cases."""
        self._of, self._model = provider, model
        self._half = LruCache(self._halve, LENDERS + 4)

    def case(self, index: int) -> Case | None:
        """Gather what the completion of a keyframe's depth rests on, by its place in the backbone; None with hardly any
        sure pixel."""
        lenders = self._of._present(self._of._neighbours(index, LENDERS)).tolist()
        others = [self._half(j) for j in lenders]
        lent = [_HALF @ self._of._warps(j, np.array([index]))[0] @ _TWICE for j in lenders]
        asked = [_HALF @ warp @ _TWICE for warp in self._of._warps(index, np.array(lenders, np.int64))]
        return consider(self._half(index), others, lent, asked)

    def estimate(self, index: int) -> DepthEstimate:
        """Depth and confidence of one keyframe: its own where it is sure, else what is chosen."""
        (depth, confidence), case = self._of._fused(index), self.case(index)
        if case is None or self._model is None:
            return DepthEstimate(depth, np.minimum(confidence, SURE))
        chosen, sure = upsample_depth(*complete(case, self._model), self._of._small(index)), confidence >= SURE
        trust = np.minimum(chosen.confidence, LENT_CONFIDENCE)
        return DepthEstimate(np.where(sure, depth, chosen.depth), np.where(sure, confidence, trust))

    def _halve(self, index: int) -> Half:
        size = -(-self._of.camera.width // 2), -(-self._of.camera.height // 2)
        return halved(*self._of._fused(index), resize_area(self._of._small(index), *size), self._of._contrast(index))
