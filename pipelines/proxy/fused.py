"""Learned and multi-view depth together: the geometry leads where views agree, the network fills and sets metres."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.camera import project
from pipelines.proxy.multiview import MultiviewDepth
from pipelines.proxy.providers import DepthEstimate, DepthProvider
from pipelines.proxy.sequence import Sequence
from pipelines.proxy.stereo.fill import SURE
from pipelines.types import Frame

_GRID_REACH = 1 / 10
"""Standard deviation of the scale grid's smoothing, as a part of the image's width."""
_PRIOR = 0.02
_TRUSTED_SPREAD = 0.05
_LEARNED_CONFIDENCE = 0.7
_OUTLIER = 0.05
_FAR_OFF, _PROVEN = 0.2, 0.7


class FusedDepth:
    """Depth in the learned provider's unit (metres).

    Where the views agree, the multi-view depth times one scale for the whole run. Elsewhere the learned depth,
    bent to the geometry around it by a smooth scale field of the frame.
    """

    def __init__(self, learned: DepthProvider, stereo: MultiviewDepth, sequence: Sequence) -> None:
        self._learned, self._stereo, self._sequence = learned, stereo, sequence
        self.name = f"{learned.name}+multiview"
        self.metric = learned.metric
        self._scales: dict[int, float] = {}
        self._scale = 1.0

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames that neither knows."""
        return [f for f in self._learned.missing(frames) if f in self._stereo.missing(frames)]

    def prepare(self, frames: list[Frame]) -> None:
        """Both providers' passes, then the scale between them."""
        self._learned.prepare(frames)
        self._stereo.prepare(frames)
        for frame in frames:
            ratio = self._ratio(frame)
            if ratio is not None:
                self._scales[frame.id] = ratio
        if self._scales:
            self._scale = float(np.median(list(self._scales.values())))

    def _ratio(self, frame: Frame) -> float | None:
        """Learned depth over the depth of the sparse points that the frame observes; None with too few."""
        model, camera = self._sequence.backbone, self._sequence.intrinsics
        if model is None or frame.id not in self._sequence.cam_from_world:
            return None
        index = int(np.flatnonzero(model.frame_ids == frame.id)[0])
        points = model.points_in_world[model.obs_point[model.obs_frame == index]]
        cam_from_world = model.cam_from_world[index]
        xy, z = project(points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], camera)
        ok = (z > 0) & (xy > 0).all(1) & (xy < [camera.width, camera.height]).all(1)
        column, row = np.floor(np.where(ok[:, None], xy, 0)).astype(np.int64).T
        learned = self._learned.estimate(frame).depth[row, column]
        ok &= learned > 0
        return float(np.median(learned[ok] / z[ok])) if ok.sum() >= 20 else None

    def estimate(self, frame: Frame) -> DepthEstimate:
        """The fused depth."""
        learned = self._learned.estimate(frame)
        geometry = self._stereo.estimate(frame)
        return fuse(learned, geometry, self._scale, self._scales.get(frame.id, self._scale))

    def figures(self) -> dict[str, Any]:
        """Metres per unit of the backbone and its relative spread over the frames."""
        values = np.array(list(self._scales.values()))
        spread = 1.4826 * float(np.median(np.abs(values / self._scale - 1))) if len(values) else 0.0
        return {
            **self._learned.figures(),
            **self._stereo.figures(),
            "metres_per_unit": round(self._scale, 6),
            "scale_spread": round(spread, 4),
        }


def fuse(learned: DepthEstimate, geometry: DepthEstimate, scale: float, frame_scale: float) -> DepthEstimate:
    """One frame's learned depth and multi-view depth (times `scale` in the learned unit) as one.

    `frame_scale` is what this frame's learned depth says of the scale: where no geometry is near, the learned depth
    is corrected by scale / frame_scale.
    """
    lead = (geometry.confidence >= SURE) & (geometry.depth > 0)
    both = lead & (learned.depth > 0)
    base = np.log(scale / frame_scale)
    ratio = np.log(np.where(both, geometry.depth * scale, 1)) - np.log(np.where(both, learned.depth, 1)) - base
    weight = np.where(both, geometry.confidence, 0).astype(np.float64)
    field, spread = _smooth_field(ratio, weight)
    for _ in range(2):
        field, spread = _smooth_field(ratio, weight / (1 + ((ratio - field) / _OUTLIER) ** 2))
    # A wrong match agrees with a view or two by chance, but then stands far off the learned surface as well.
    lead &= ~both | (np.abs(ratio - field) < _FAR_OFF) | (geometry.confidence > _PROVEN)
    bent = learned.depth * np.exp(base + field)
    sure = np.maximum(_LEARNED_CONFIDENCE * np.exp(-((spread / _TRUSTED_SPREAD) ** 2)), 0.1) * learned.confidence
    depth = np.where(lead, geometry.depth * scale, bent).astype(np.float32)
    confidence = np.where(lead, geometry.confidence, np.where(depth > 0, sure, 0)).astype(np.float32)
    guess = (depth <= 0) & (geometry.depth > 0)
    depth = np.where(guess, geometry.depth * scale, depth).astype(np.float32)
    return DepthEstimate(depth, np.where(guess, geometry.confidence, confidence).astype(np.float32), learned.invalid)


def _smooth_field(
    ratio: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted local mean of the log ratio, 0 far from any evidence, and the local spread around it."""
    sigma = ratio.shape[1] * _GRID_REACH
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
