"""How close a rendered image is to a photograph."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.types import require_shape

_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
_TAPS, _SIGMA = 11, 1.5


def psnr(image: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of (H, W, 3) images in 0..255, over `mask` (H, W); inf for equal images.

    Raises ValueError for different shapes or an empty mask.
    """
    require_shape("image", image, truth.shape)
    squared = (image.astype(np.float64) - truth.astype(np.float64)) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        raise ValueError("psnr: no pixel to compare")
    error = float(squared.mean())
    return float("inf") if error == 0 else 10 * float(np.log10(255.0**2 / error))


def ssim(image: NDArray, truth: NDArray) -> float:
    """Mean structural similarity of (H, W, 3) images in 0..255 (Wang et al., TIP 2004), -1..1.

    Gaussian window of 11 pixels and sigma 1.5, population covariance, mean over channels and over the pixels whose
    window lies in the image. Raises ValueError for images smaller than the window.
    """
    require_shape("image", image, truth.shape)
    if min(image.shape[:2]) < _TAPS:
        raise ValueError(f"ssim: images need at least {_TAPS} pixels a side, got {image.shape[:2]}")
    a, b = image.astype(np.float64), truth.astype(np.float64)
    mean_a, mean_b = _blurred(a), _blurred(b)
    var_a, var_b = _blurred(a * a) - mean_a**2, _blurred(b * b) - mean_b**2
    covariance = _blurred(a * b) - mean_a * mean_b
    similarity = ((2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)) / (
        (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    )
    edge = _TAPS // 2
    return float(similarity[edge:-edge, edge:-edge].mean())


def _blurred(image: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.GaussianBlur(image, (_TAPS, _TAPS), _SIGMA), np.float64)
