"""World Gaussians seen by a camera: projection (MSGS-SLAM eq. 5) in torch around the compositing kernel."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from ...geometry import se3
from ...geometry.camera import project_gaussians
from ...types import Intrinsics
from . import cards
from .compositing import (
    check_arguments,
    choose_backend,
    composite,
    require_finite,
)
from .culling import NEAR, in_view


@dataclass(frozen=True)
class Rendering:
    """features (H, W, C); depth (H, W) = depth sum / depth silhouette, 0 where nothing is seen; silhouette (H, W)."""

    features: Tensor
    depth: Tensor
    silhouette: Tensor


def render(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    features: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    twist: Tensor | None = None,
    near: float = NEAR,
    backend: str | None = None,
) -> Rendering:
    """Draw M Gaussians from the pose exp(twist) @ cam_from_world; differentiable in all of them.

    means (M, 3), radii (M,) world standard deviations, opacities (M,) 0..1, features (M, C), cam_from_world (4, 4),
    twist (6,) translation first (see `pipelines.geometry.se3`). Pose and twist best stay on
    the host where the Gaussians lie on a card: on six numbers a card is slower. Raises ValueError for wrong shapes, and
    for NaN and infinity in what lies on the CPU.
    """
    pose = cam_from_world if twist is None else moved(cam_from_world, twist)
    if (kernels := kernels_for(backend, means)) is not None:
        size = (intrinsics.width, intrinsics.height)
        check_arguments({"radii": radii, "opacities": opacities, "features": features}, *size)
        records = kernels.project(means, radii, opacities, beside(pose, means), intrinsics, near)
        shown, above, below, silhouette = kernels.composite_records(records, features, *size)
        return Rendering(shown, kernels.depth_ratio(above, below), silhouette)
    if not torch.is_grad_enabled():
        rows = in_view(means, radii, pose, intrinsics, near)
        means, radii, opacities, features = means[rows], radii[rows], opacities[rows], features[rows]
    u, v, sigma_px, z = project_map(means, radii, pose, intrinsics, near)
    image = composite(u, v, sigma_px, z, opacities, features, intrinsics.width, intrinsics.height, backend, near)
    depth = depth_ratio(image.depth_sum, image.depth_silhouette)
    return Rendering(image.features, depth, image.silhouette)


def kernels_for(backend: str | None, example: Tensor) -> ModuleType | None:
    """The kernels that also project, where tensors like `example` take them; they need no culling before."""
    if backend != "cuda" and (backend is not None or not cards.takes_kernels(example)):
        return None
    return choose_backend("cuda", example)


def moved(cam_from_world: Tensor, twist: Tensor) -> Tensor:
    """exp(twist) @ cam_from_world in the pose's own precision (float64 in this project); raises ValueError for NaN in
    a twist on the CPU."""
    require_finite("twist", twist)
    return se3.exp(twist.to(cam_from_world.dtype)) @ cam_from_world


def project_map(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """u, v, sigma_px, z (M,) of the Gaussians in the camera; raises ValueError for NaN in what lies on the CPU."""
    for name, tensor in (("means", means), ("radii", radii), ("cam_from_world", cam_from_world)):
        require_finite(name, tensor)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        from .cpu_projection import project  # imports numba

        return project(means, radii, beside(cam_from_world, means), intrinsics, near)
    points_in_cam = se3.transform(beside(cam_from_world, means), means)
    return project_gaussians(points_in_cam, radii, intrinsics, near)


def beside(numbers: Tensor, other: Tensor) -> Tensor:
    """`numbers` where `other` lies and in its type; the gradient comes back in one copy."""
    if numbers.device == other.device:
        return numbers.to(other)
    return _Beside.apply(numbers, other)


class _Beside(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numbers: Tensor, other: Tensor) -> Tensor:
        ctx.device, ctx.dtype = numbers.device, numbers.dtype
        return numbers.detach().to(other)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0].to(ctx.device).to(ctx.dtype), None


def depth_ratio(depth_sum: Tensor, depth_silhouette: Tensor) -> Tensor:
    """Depth sum / depth silhouette with value and gradient 0 where no Gaussian is seen."""
    seen = depth_silhouette > 1e-6
    return torch.where(seen, depth_sum / torch.where(seen, depth_silhouette, 1.0), 0.0)
