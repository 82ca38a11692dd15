"""Learned and multi-view depth together: the geometry leads where views agree, the network fills and sets metres."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..providers import DepthEstimate, DepthProvider, Sequence
from ..types import Frame
from .scale import DepthScale, measure_scale
from .stereo.fill import SURE
from .stereo.provider import MultiviewDepth

_GRID_REACH = 1 / 10
"""Standard deviation of the scale grid's smoothing, as a part of the image's longer side."""
_PRIOR = 0.02
_TRUSTED_SPREAD = 0.05
_LEARNED_CONFIDENCE = 0.7
_OUTLIER = 0.05
_FAR_OFF, _PROVEN = 0.2, 0.7
_GUESS_SHARE, _GUESS_SPREAD, _GUESS_GAP = 0.9, 0.02, 0.15
"""Where the views do not agree, the geometry guesses from its surroundings, and is as good as a network: two guesses
that miss differently are better together. Its share grows with how much the network strays around the scale field, and
fades as the two differ more (all in log depth)."""


class FusedDepth(DepthProvider):
    """Depth in the learned provider's unit (metres).

    Where the views agree, the multi-view depth times one scale for the whole run. Elsewhere the learned depth,
    bent to the geometry around it by a smooth scale field of the frame, together with what the geometry guesses there.
    """

    shared_state = ("_learned", "_stereo", "_scale")

    def __init__(self, learned: DepthProvider, stereo: MultiviewDepth, sequence: Sequence) -> None:
        self._learned, self._stereo, self._sequence = learned, stereo, sequence
        self.name = f"{learned.name}+multiview"
        self.metric = learned.metric
        self._scale = DepthScale({})

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames that neither knows."""
        return [f for f in self._learned.missing(frames) if f in self._stereo.missing(frames)]

    def precompute(self, frames: list[Frame]) -> None:
        """Run the passes of both providers on these frames."""
        self._learned.precompute(frames)
        self._stereo.precompute(frames)

    def fit(self, frames: list[Frame]) -> None:
        """Both providers' passes, then the scale between them."""
        self._learned.fit(frames)
        self._stereo.fit(frames)
        self._scale = measure_scale(self._sequence, frames, self._learned.estimate)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Fuse the learned depth of a frame with its stereo depth."""
        learned = self._learned.estimate(frame)
        geometry = self._stereo.estimate(frame)
        run_scale = self._scale.value
        return fuse(learned, geometry, run_scale, self._scale.of_frame.get(frame.id, run_scale))

    def figures(self) -> dict[str, Any]:
        """Return the figures of learned and stereo depth together."""
        return {**self._learned.figures(), **self._stereo.figures()}


def fuse(learned: DepthEstimate, geometry: DepthEstimate, scale: float, frame_scale: float) -> DepthEstimate:
    """Fuse one frame's learned depth and multi-view depth, in the unit of the learned one.

    Args:
        learned: depth by the network.
        geometry: depth by several views, in the unit of the backbone.
        scale: of the run: turns the geometry's unit into the learned one.
        frame_scale: the same by this frame's learned depth; where no geometry is near, that is corrected by
            scale / frame_scale.
    """
    lead = (geometry.confidence >= SURE) & (geometry.depth > 0)
    both = lead & (learned.depth > 0)
    base = np.log(scale / frame_scale)
    known = (geometry.depth > 0) & (learned.depth > 0)
    in_metres = np.log(np.where(known, geometry.depth * scale, 1))
    ratio = in_metres - np.log(np.where(known, learned.depth, 1)) - base
    weight = np.where(both, geometry.confidence, 0).astype(np.float64)
    field, spread = _smooth_field(ratio, weight)
    for _ in range(2):
        field, spread = _smooth_field(ratio, weight / (1 + ((ratio - field) / _OUTLIER) ** 2))
    # A wrong match agrees with a view or two by chance, but then is far off the learned surface as well.
    lead &= ~both | (np.abs(ratio - field) < _FAR_OFF) | (geometry.confidence > _PROVEN)
    guessed = known & (geometry.confidence < SURE)
    doubt = spread**2 / (spread**2 + _GUESS_SPREAD**2)
    share = np.where(guessed, _GUESS_SHARE * doubt * np.exp(-(((ratio - field) / _GUESS_GAP) ** 2)), 0)
    bent = learned.depth * np.exp(base + field + share * (ratio - field))
    sure = np.maximum(_LEARNED_CONFIDENCE * np.exp(-((spread / _TRUSTED_SPREAD) ** 2)), 0.1) * learned.confidence
    depth = np.where(lead, geometry.depth * scale, bent).astype(np.float32)
    confidence = np.where(lead, geometry.confidence, np.where(depth > 0, sure, 0)).astype(np.float32)
    guess = (depth <= 0) & (geometry.depth > 0)
    depth = np.where(guess, geometry.depth * scale, depth).astype(np.float32)
    confidence = np.where(guess, geometry.confidence, confidence).astype(np.float32)
    return DepthEstimate(depth, confidence, learned.invalid, learned.normals)


def _smooth_field(
    ratio: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted local mean of the log ratio, 0 far from any evidence, and the local spread around it."""
    sigma = max(ratio.shape) * _GRID_REACH
    # A blur over a quarter-size image is the same field at a sixteenth of the time.
    size = (max(1, ratio.shape[1] // 4), max(1, ratio.shape[0] // 4))

    def blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
        small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), sigma / 4, borderType=cv2.BORDER_REFLECT)
        return np.asarray(cv2.resize(small, ratio.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float64)

    mass = blur(weight)
    mean = blur(weight * ratio) / (mass + _PRIOR)
    residual = blur(weight * (ratio - mean) ** 2) / (mass + _PRIOR)
    return mean, np.sqrt(np.maximum(residual, 0)) + _TRUSTED_SPREAD * _PRIOR / (mass + _PRIOR)
