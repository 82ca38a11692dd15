"""SIFT features of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipelines.types import require_shape

DESCRIPTOR_NORM = 512
"""Length of a descriptor: COLMAP stores the root of L1-normalised SIFT times this, rounded to bytes."""


@dataclass(frozen=True)
class Features:
    """keypoints (F, 4) float32: x, y in pixels, scale, orientation in radians; descriptors (F, 128) uint8."""

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def __post_init__(self) -> None:
        require_shape("keypoints", self.keypoints, (None, 4))
        require_shape("descriptors", self.descriptors, (len(self.keypoints), 128))

    def __len__(self) -> int:
        return len(self.keypoints)

    def outside(self, left_out: NDArray[np.bool_] | None) -> Features:
        """Those that do not lie in a mask (H, W)."""
        if left_out is None or len(self) == 0:
            return self
        column, row = self.keypoints[:, :2].astype(np.int64).T
        kept = ~left_out[row.clip(0, left_out.shape[0] - 1), column.clip(0, left_out.shape[1] - 1)]
        return Features(self.keypoints[kept], self.descriptors[kept])

    @property
    def xy(self) -> NDArray[np.float64]:
        """(F, 2) pixels."""
        return self.keypoints[:, :2].astype(np.float64)


class FeatureExtractor:
    """SIFT on one thread: the same image gives the same bytes. Keep one for each thread."""

    def __init__(self, max_features: int, peak_threshold: float) -> None:
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.max_num_features = max_features
        options.sift.peak_threshold = peak_threshold
        # A second orientation gives a second keypoint at the same place: it costs matching time and adds no geometry.
        options.sift.max_num_orientations = 1
        self._extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)

    def __call__(self, gray: NDArray[np.uint8]) -> Features:
        """Features of an (H, W) uint8 image."""
        require_shape("gray", gray, (None, None))
        keypoints, descriptors = self._extractor.extract_from_uint8_array(np.ascontiguousarray(gray))
        if len(keypoints) == 0:
            return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
        return Features(pycolmap.keypoints_to_matrix(keypoints), np.asarray(descriptors.data, dtype=np.uint8))
