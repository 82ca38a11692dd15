"""Error of rendered depth against the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import require_shape


@dataclass(frozen=True)
class DepthError:
    """metric_l1: mean |depth - truth| in metres as it is; scaled_l1: after one scale for the whole sequence;
    scale: that factor; valid_fraction: share of the pixels with truth where there is a depth at all; pixels: those
    compared."""

    metric_l1: float
    scaled_l1: float
    scale: float
    valid_fraction: float
    pixels: int


class DepthErrorSum:
    """Depth L1 over a sequence, frame by frame.

    Depths are first multiplied by the scale of the trajectory's alignment where the caller asks for it; the one scale
    of `scaled_l1` is the median of truth / depth over a sample of all pixels.
    """

    def __init__(self, samples_a_frame: int = 20000) -> None:
        self._samples_a_frame = samples_a_frame
        self._errors = 0.0
        self._compared = 0
        self._truths = 0
        self._samples: list[NDArray[np.float32]] = []

    def add(self, depth: NDArray[np.float32], truth: NDArray[np.float32]) -> None:
        """One frame, both (H, W) in metres, 0 = unknown."""
        require_shape("depth", depth, truth.shape)
        known = truth > 0
        both = known & (depth > 0) & np.isfinite(depth)
        self._truths += int(known.sum())
        self._compared += int(both.sum())
        self._errors += float(np.abs(depth[both].astype(np.float64) - truth[both]).sum())
        pairs = np.stack([depth[both], truth[both]], axis=1)
        # Every k-th pixel: even over the image, and the same on every run.
        self._samples.append(pairs[:: max(1, len(pairs) // self._samples_a_frame)])

    def result(self) -> DepthError | None:
        """None where no pixel could be compared."""
        if self._compared == 0:
            return None
        sample = np.concatenate(self._samples).astype(np.float64)
        scale = float(np.median(sample[:, 1] / sample[:, 0]))
        return DepthError(
            metric_l1=self._errors / self._compared,
            scaled_l1=float(np.abs(scale * sample[:, 0] - sample[:, 1]).mean()),
            scale=scale,
            valid_fraction=self._compared / self._truths,
            pixels=self._compared,
        )
