"""A keyframe's depth completed where its views do not agree: candidates, evidence and choice, at half the size."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.fill import SURE, agreed_depth, carry_depth
from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.depth.stereo.sweep import warps_to
from msgs_slam.pipelines.depth.stereo.upsample import upsample_depth
from msgs_slam.pipelines.geometry.voxels import to_lab
from msgs_slam.pipelines.providers import DepthEstimate, resize_area
from msgs_slam.pipelines.system.parallel import LruCache

from .candidates import Candidates, Known, find_candidates, find_planes
from .evidence import View, gather_evidence
from .model import ChoiceModel, choose

_LENDERS, _ASKED = 16, 8
"""Keyframes that lend sure depths, and those that say whether a candidate can be."""
_LEAST_PIXELS = 40
_MOST_CONFIDENCE, _FADING = 0.4, 0.05
_LEAST = 0.5
"""Likeness of colour that the agreeing views must have together; a view of the same colour counts 1."""


@dataclass(frozen=True)
class Half:
    """A keyframe at half the size: inverse depth (0: none) and confidence (h, w) of the surest of four pixels, picture
    (h, w, 3) as RGB and in CIE Lab."""

    inverse: NDArray[np.float32]
    confidence: NDArray[np.float32]
    image: NDArray[np.uint8]
    lab: NDArray[np.float32]

    @property
    def surely(self) -> NDArray[np.float32]:
        """(h, w) inverse depth where it is sure."""
        return np.where(self.confidence >= SURE, self.inverse, np.float32(0))


@dataclass(frozen=True)
class Case:
    """What the choice is about: candidates and evidence (P, K, F) of the pixels without a sure match, the picture."""

    known: Known
    found: Candidates
    evidence: NDArray[np.float32]
    lab: NDArray[np.float32]


def halved(depth: NDArray[np.float32], confidence: NDArray[np.float32], image: NDArray[np.uint8]) -> Half:
    """Of depth and confidence (H, W) and the picture (H/2, W/2, 3), both rounded up."""
    height, width = image.shape[:2]
    pad = ((0, 2 * height - depth.shape[0]), (0, 2 * width - depth.shape[1]))
    blocks = []
    for values in (depth, np.where(depth > 0, confidence, 0)):
        whole = np.pad(values, pad, mode="edge").reshape(height, 2, width, 2)
        blocks.append(whole.transpose(0, 2, 1, 3).reshape(height, width, 4))
    best = blocks[1].argmax(-1)[..., None]
    found, sure = (np.take_along_axis(b, best, -1)[..., 0] for b in blocks)
    inverse = np.divide(1, found, out=np.zeros(found.shape, np.float32), where=found > 0)
    return Half(inverse, sure.astype(np.float32), image, to_lab(image))


def consider(
    own: Half, lenders: list[Half], lent: list[NDArray[np.float64]], asked: list[NDArray[np.float64]], seed: int
) -> Case | None:
    """Everything that the choice rests on; None with hardly any sure pixel.

    `lent` (3, 4) lead from the lenders' pixels to the keyframe's, `asked` back from it to those of the first of them.
    """
    wanted = own.confidence < SURE
    carried = [
        carry_depth(_depth(h.inverse), h.confidence, h.lab, warp, own.lab)
        for h, warp in zip(lenders, lent, strict=True)
    ]
    depth, mass = agreed_depth(carried, wanted) if carried else (np.zeros_like(own.inverse),) * 2
    borrowed = wanted & (mass > _LEAST)
    if (~wanted).sum() < _LEAST_PIXELS:
        return None
    known = Known(own.inverse, own.confidence, _depth(depth), mass)
    sure = ~wanted | borrowed
    others = lenders[: len(asked)]
    seen = [(h.surely, warp) for h, warp in zip(others, lent, strict=False)]
    planes = find_planes([(own.surely, np.eye(3, 4)), *seen], seed)
    found = find_candidates(known, sure, own.image, planes, np.flatnonzero(wanted))
    views = [View(h.inverse, h.confidence, h.lab, warp) for h, warp in zip(others, asked, strict=True)]
    return Case(known, found, gather_evidence(found, known, sure, own.lab, views), own.lab)


def complete(case: Case, model: ChoiceModel) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and confidence (h, w) at half the size, chosen where the match was not sure."""
    cost, error = model.judge(case.evidence)
    chosen, predicted = choose(case.found.inverse, cost, error, case.found.pixels, case.lab)
    inverse, confidence = case.known.inverse.copy(), case.known.confidence.copy()
    inverse.ravel()[case.found.pixels] = chosen
    confidence.ravel()[case.found.pixels] = confidence_of(predicted)
    return _depth(inverse), confidence


def confidence_of(error: NDArray[np.float32]) -> NDArray[np.float32]:
    """Confidence of a chosen depth by its predicted error in log depth."""
    return np.asarray(_MOST_CONFIDENCE * np.exp(-error / _FADING), np.float32)


class Completion:
    """The completion of a provider's keyframes, in place of its own."""

    def __init__(self, provider: MultiviewDepth, model: ChoiceModel | None = None) -> None:
        """Without a model there are only cases."""
        self._of, self._model = provider, model
        self._half = LruCache(self._halve, _LENDERS + 4)

    def case(self, index: int) -> Case | None:
        """What the completion of a keyframe rests on, by its index in the backbone; None with hardly a sure pixel."""
        others = self._of._present(self._of._neighbours(index, _LENDERS))
        lent = [self._warps(j, np.array([index]))[0] for j in others.tolist()]
        asked = list(self._warps(index, others[:_ASKED]))
        return consider(self._half(index), [self._half(j) for j in others.tolist()], lent, asked, index + 1)

    def estimate(self, index: int) -> DepthEstimate:
        """Depth and confidence of one keyframe: its own where it is sure, else what is chosen."""
        (depth, confidence), case = self._of._fused(index), self.case(index)
        if case is None or self._model is None:
            return DepthEstimate(depth, np.minimum(confidence, SURE))
        chosen = upsample_depth(*complete(case, self._model), self._of._small(index))
        sure = confidence >= SURE
        return DepthEstimate(
            np.where(sure, depth, chosen.depth), np.where(sure, confidence, chosen.confidence).astype(np.float32)
        )

    def _halve(self, index: int) -> Half:
        height, width = (-(-s // 2) for s in (self._of._camera.height, self._of._camera.width))
        return halved(*self._of._fused(index), resize_area(self._of._small(index), width, height))

    def _warps(self, index: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        matrix, poses = np.diag([0.5, 0.5, 1]) @ self._of._camera.matrix, self._of._model.cam_from_world
        return warps_to(matrix, poses[index], [matrix] * len(others), [poses[j] for j in others])


def _depth(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
