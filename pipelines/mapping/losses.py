"""The terms of the mapping loss (MSGS-SLAM eqs. 18-20), each a scalar that does not depend on the unit of depth."""

from __future__ import annotations

import torch
from torch import Tensor

NU = 1.2
"""ν of eq. (18)."""
SIZE_LIMIT = 0.03
"""Radius above which a Gaussian is too large, in units of the scene's median depth."""


def depth_weight(reliability: Tensor) -> Tensor:
    """min(1, ν U) of eq. (18), (H, W)."""
    return (NU * reliability).clamp(max=1.0)


def depth_loss(rendered: Tensor, proxy: Tensor, weight: Tensor, unit: float) -> Tensor:
    """w |D̂ - D| of eq. (18), in units of the scene's depth; mean over all H x W pixels, unknown proxy (0) counts 0."""
    known = proxy > 0
    return ((rendered - proxy).abs() * weight * known).mean() / unit


def size_loss(log_radii: Tensor, unit: float) -> Tensor:
    """L_reg of eq. (18): mean squared log excess of (M,) radii over the limit, `unit` being the scene's depth.

    0 without a Gaussian.
    """
    excess = (log_radii - torch.log(torch.tensor(SIZE_LIMIT * unit, device=log_radii.device))).clamp(min=0)
    return (excess * excess).sum() / max(len(excess), 1)


def silhouette_loss(silhouette: Tensor) -> Tensor:
    """Mean transparency left over: presses the map to be opaque, without which it slowly turns to fog."""
    return (1 - silhouette).mean()
