"""Choice of places that need Gaussians (two of the three conditions of MSGS-SLAM 3.4) and of Gaussians to prune."""

from __future__ import annotations

import torch
from torch import Tensor

from ..gaussian_map import GaussianMap


def holes(silhouette: Tensor, least: float) -> Tensor:
    """(H, W) bool: condition (a), the map does not cover the pixel."""
    return silhouette < least


def hidden_surfaces(rendered: Tensor, proxy: Tensor, trust: Tensor, tolerance: float) -> Tensor:
    """(H, W) bool: condition (b), a trusted proxy is nearer than the map by more than `tolerance` of its depth.

    The less the proxy is trusted, the larger the difference has to be.
    """
    allowed = tolerance * proxy / trust.clamp(min=0.1)
    return (proxy > 0) & (rendered - proxy > allowed)


def useless(gaussian_map: GaussianMap, least_opacity: float, largest_radius: float) -> Tensor:
    """(M,) bool: too transparent, too large or not finite."""
    finite = torch.isfinite(gaussian_map.means).all(1) & torch.isfinite(gaussian_map.log_radii)
    finite &= torch.isfinite(gaussian_map.colors).all(1) & torch.isfinite(gaussian_map.opacity_logits)
    return ~finite | (gaussian_map.opacities < least_opacity) | (gaussian_map.radii > largest_radius)
