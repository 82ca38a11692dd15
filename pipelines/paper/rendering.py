"""Semantic Gaussians and what a camera sees of them (section 3.2)."""

import torch
from torch import Tensor

from ..geometry.camera import project_gaussians
from ..geometry.se3 import transform
from ..render import reference
from ..render.api import NEAR, Rendering, depth_ratio, in_view, render
from ..types import Intrinsics


def density(points: Tensor, mean: Tensor, radius: Tensor, opacity: Tensor) -> Tensor:
    """Eq. (4): f(x) = σ exp(-‖x - μ‖² / 2r²) of one isotropic Gaussian at points (..., 2 or 3)."""
    return opacity * torch.exp(-(points - mean).square().sum(-1) / (2 * radius * radius))


def projection(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics
) -> tuple[Tensor, Tensor, Tensor]:
    """Eq. (5): μ²ᴰ = K E μ / d (M, 2), r²ᴰ = f r / d (M,) and d = (E μ)_z (M,) of means (M, 3) and radii (M,)."""
    u, v, radius, depth = project_gaussians(transform(cam_from_world.to(means), means), radii, intrinsics, NEAR)
    return torch.stack([u, v], 1), radius, depth


def occluder_weight(depth: Tensor, proxy: Tensor, kappa: float) -> Tensor:
    """w_d(d, D̂) = exp(-κ|d - D̂|²) of Eq. (7): an occluder that disagrees with the proxy hides less; 1 without one."""
    return torch.where(proxy > 0, torch.exp(-kappa * (depth - proxy).square()), torch.ones_like(depth))


def draw(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    features: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    twist: Tensor | None = None,
    proxy: Tensor | None = None,
    kappa: float = 0.0,
) -> Rendering:
    """Eqs. (6) to (9) for every pixel, by the compiled renderer: features are colours (M, 3) beside semantics.

    The depth is that of Eq. (7) over its own weights. With κ > 0 it comes from the renderer in plain torch, where
    proxy (H, W) says which occluders to believe.
    """
    seen = render(means, radii, opacities, features, cam_from_world, intrinsics, twist)
    if kappa == 0 or proxy is None:
        return seen
    return Rendering(
        seen.features,
        weighted_depth(means, radii, opacities, cam_from_world, intrinsics, proxy, kappa),
        seen.silhouette,
    )


def weighted_depth(
    means: Tensor, radii: Tensor, opacities: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, proxy: Tensor,
    kappa: float,
) -> Tensor:  # fmt: skip
    """Eq. (7) over the image, (H, W), divided by its weights: differentiable in means, radii and opacities."""
    rows = in_view(means, radii, cam_from_world, intrinsics)
    centers, radius, depth = projection(means[rows], radii[rows], cam_from_world, intrinsics)
    (u, v), width, height = centers.unbind(1), intrinsics.width, intrinsics.height
    pairs = reference.list_pairs(u, v, radius, depth, opacities[rows], width, height, NEAR)
    f, d = reference.pair_opacities(pairs, u, v, radius, depth, opacities[rows], width)
    hidden = f * occluder_weight(d, proxy.reshape(-1)[pairs.pixel], kappa)
    weights = f * reference.transmittance_before(hidden, pairs)
    sums = [torch.zeros(height * width).to(d).index_add(0, pairs.pixel, x) for x in (weights * d, weights)]
    return depth_ratio(*sums).view(height, width)
