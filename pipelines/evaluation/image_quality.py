"""Similarity of a rendered image to a photograph."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..compute.ssim import TAPS, similarity
from ..types import require_shape


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
    if min(image.shape[:2]) < TAPS:
        raise ValueError(f"ssim: images need at least {TAPS} pixels a side, got {image.shape[:2]}")
    a, b = (torch.from_numpy(x.astype(np.float64) / 255) for x in (image, truth))
    edge = TAPS // 2
    return float(similarity(a, b)[0][edge:-edge, edge:-edge].mean())
