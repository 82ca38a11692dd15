"""Depth as a large network errs: smoothly within a frame, by a scale from frame to frame, with blurred steps."""

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.providers import DepthEstimate, DepthProvider
from msgs_slam.pipelines.types import Frame

from .textures import Random

BLUR = 1 / 200
"""Standard deviation of the blur of inverse depth, in widths."""
_NODES = (7, 9)
_CONFIDENCE = 0.9


def network_like(truth: NDArray[np.floating], percent: float, r: Random, blur: float = BLUR) -> NDArray[np.float32]:
    """(h, w) true depth, 0 = unknown, with a smooth error of `percent` and half of that as a scale."""
    height, width = truth.shape
    known = (truth > 0).astype(np.float32)
    inverse = np.divide(1, truth, out=np.zeros(truth.shape), where=truth > 0).astype(np.float32)
    if blur:
        inverse, mass = (cv2.GaussianBlur(a, (0, 0), blur * width) for a in (inverse, known))
        inverse = inverse / np.maximum(mass, np.float32(1e-6))
    field = cv2.resize(r.normal(size=_NODES).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    off = np.exp(percent / 100 * (field / field.std() + r.normal() / 2))
    return (known * off / np.where(inverse > 0, inverse, 1)).astype(np.float32)


class NetworkLike(DepthProvider):
    """Such depth of frames whose truth (h, w) is known, by frame id."""

    name, metric = "network", True

    def __init__(self, truth: Mapping[int, NDArray[np.floating]], percent: float, seed: int) -> None:
        r = np.random.default_rng(seed)
        self._depth = {i: network_like(depth.astype(np.float32), percent, r) for i, depth in truth.items()}

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without truth."""
        return [f for f in frames if f.id not in self._depth]

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Its depth; where there is none, confidence 0."""
        depth = self._depth[frame.id]
        return DepthEstimate(depth, np.where(depth > 0, np.float32(_CONFIDENCE), np.float32(0)))
