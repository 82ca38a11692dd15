"""Depth of the region where the proxy is unreliable, MSGS-SLAM eq. (17), for seeds.

Since stereo fills what it cannot match, what it changes is within noise on whole recordings.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import VOID

_MIN_REGION = 64
_REGION_SAMPLES = 4000


def with_region_prior(
    depth: NDArray[np.float32], trust: NDArray[np.float32], channels: NDArray[np.uint8], low: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth, 0 = unknown, and trust (H, W), in which pixels trusted up to `low` have the depth of their region.

    A region is connected and of one class in channels (H, W); μ_k of eq. (17) is a plane in inverse depth over it, so
    that slanted walls keep their slant.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    out, out_trust = inverse.copy(), np.where(depth > 0, trust, 0).astype(np.float32)
    trust = out_trust.copy()
    for channel in np.unique(channels[channels != VOID]):
        mask = (channels == channel).astype(np.uint8)
        _, regions, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        for region in 1 + np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= _MIN_REGION):
            left, top, width, height = boxes[region, : cv2.CC_STAT_AREA]
            rows, columns = np.nonzero(regions[top : top + height, left : left + width] == region)
            rows, columns = rows + top, columns + left
            weak = trust[rows, columns] <= low
            reliable = ~weak & (inverse[rows, columns] > 0)
            if not weak.any() or reliable.sum() < _MIN_REGION:
                continue
            mean, spread = _fit_plane(columns, rows, inverse[rows, columns], reliable)
            rows, columns, mean = rows[weak], columns[weak], mean[weak]
            seen, weight = inverse[rows, columns], trust[rows, columns]
            # The proxy's own precision at reliability U is taken as U² / 5 %²; the prior's is its residual spread.
            proxy_precision = np.where(seen > 0, (weight / (0.05 * np.maximum(seen, 1e-9))) ** 2, 0)
            prior_precision = 1 / max(spread, 1e-9) ** 2
            fused = (proxy_precision * seen + prior_precision * mean) / (proxy_precision + prior_precision)
            good = (mean > 0) & (spread < 0.1 * mean)
            out[rows[good], columns[good]] = fused[good]
            out_trust[rows[good], columns[good]] = np.maximum(weight[good], low / 2)
    return out, out_trust


def _fit_plane(
    columns: NDArray, rows: NDArray, values: NDArray[np.float32], use: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], float]:
    """Robust plane a x + b y + c through the used values, at all places, and the spread of its residuals."""
    picked = np.flatnonzero(use)
    picked = picked[:: max(len(picked) // _REGION_SAMPLES, 1)]
    design = np.stack([columns, rows, np.ones(len(rows))], 1) / [1000, 1000, 1]
    target, weights = values[picked].astype(np.float64), np.ones(len(picked))
    for _ in range(5):
        a = design[picked] * weights[:, None]
        plane = np.linalg.lstsq(a, target * weights, rcond=None)[0]
        residual = np.abs(design[picked] @ plane - target)
        spread = 1.4826 * float(np.median(residual))
        weights = np.sqrt(1 / np.maximum(residual / max(spread, 1e-9), 1))
    return (design @ plane).astype(np.float32), spread
