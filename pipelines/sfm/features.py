"""SIFT features of an image: the only extractor there is.

COLMAP's: OpenCV's takes 40 % of its time, and the path of all frames is as good on six recordings, but of a noisy
classroom half as far off again (tests/benchmarks/README.md).
"""

import threading

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..types import Features, require_shape

_of_thread = threading.local()


PEAK_THRESHOLD = 0.004
"""Contrast of the weakest feature; lower finds more on plain walls."""
_SUPPORT = 2.0
"""Of a feature's scale: nearer to a mask than this, what moves there affects its position."""


def extract_features(
    grey: NDArray[np.uint8], count: int, left_out: NDArray[np.bool_] | None = None, threshold: float = PEAK_THRESHOLD
) -> Features:
    """SIFT features (Lowe 2004) of an (H, W) image, at most about `count`, as RootSIFT (Arandjelović and Zisserman,
    CVPR 2012).

    `threshold` is the least contrast, as a share of the range of grey. None is in the mask `left_out` (H, W), nor
    reaches into it.
    """
    require_shape("grey", grey, (None, None))
    keypoints, found = _extractor(count, threshold).extract_from_uint8_array(np.ascontiguousarray(grey))
    if len(keypoints) == 0:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    features = Features(pycolmap.keypoints_to_matrix(keypoints), np.asarray(found.data, dtype=np.uint8))
    return features if left_out is None else clear_of(features, left_out)


def clear_of(features: Features, left_out: NDArray[np.bool_]) -> Features:
    """Keep the features of an image that neither lie in its mask (H, W) nor reach into it."""
    column, row = features.keypoints[:, :2].astype(np.int64).T
    away = cv2.distanceTransform((~left_out).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = away[row.clip(0, away.shape[0] - 1), column.clip(0, away.shape[1] - 1)]
    kept = distance > _SUPPORT * features.keypoints[:, 2]
    return Features(features.keypoints[kept], features.descriptors[kept])


def _extractor(count: int, threshold: float) -> pycolmap.FeatureExtractor:
    """One on each thread: the same image gives the same bytes."""
    if getattr(_of_thread, "made", None) != (count, threshold):
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.max_num_features = count
        options.sift.peak_threshold = threshold
        # A second orientation gives a second keypoint at the same place: it costs matching time and adds no geometry.
        options.sift.max_num_orientations = 1
        _of_thread.extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        _of_thread.made = (count, threshold)
    return _of_thread.extractor
