"""Depth shaped by semantic edges, MSGS-SLAM eq. (19).

Off: with λ_E = 0.02, ζ = 2000 on 8 keyframes of replica (noisy depth and labels) 38.48 dB and 4.24 cm of depth, without
it 38.48 dB and 4.25 cm.
"""

from __future__ import annotations

import torch
from torch import Tensor

from msgs_slam.pipelines.types import VOID

SHARPNESS = 2000.0
"""ζ, for depth steps in units of the scene's median depth."""


def edge_loss(depth: Tensor, labels: Tensor, unit: float) -> Tensor:
    """MSGS-SLAM eq. (19) over horizontal and vertical neighbours of an (H, W) rendered depth.

    exp(-ζ Δ²) where the class changes (the depth may jump), 1 - exp(-ζ Δ²) inside a region (it is smooth); pairs with a
    void pixel count 0. Δ is in units of the scene's depth.
    """
    total = depth.new_zeros(())
    for dim in (0, 1):
        n = depth.shape[dim] - 1
        a, b = labels.narrow(dim, 0, n), labels.narrow(dim, 1, n)
        step = (depth.narrow(dim, 1, n) - depth.narrow(dim, 0, n)) / unit
        near = torch.exp(-SHARPNESS * step * step)
        term = torch.where(a == b, 1 - near, near)
        total = total + (term * ((a != VOID) & (b != VOID))).mean()
    return total / 2
