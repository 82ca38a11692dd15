"""Finding the pose of a camera from a nearby one: Gauss-Newton through the renderer, MSGS-SLAM eq. (16).

One evaluation, which yields the cost, its gradient and its curvature, costs less than one reverse-mode gradient. It
needs a start within about 3 cm and 1 degree (some ten pixels); from farther away it refuses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry import se3
from ..geometry.camera import project_gaussians
from ..types import Intrinsics
from .api import NEAR, require_finite

FIRST_FLOOR, FLOOR_FACTOR, LAST_FLOOR = 0.3, 0.6, 0.02
"""Residuals below the floor count quadratically, above it absolutely; the floor falls with every evaluation."""
MIN_OVERLAP, MAX_EVALUATIONS, TOLERANCE_PX = 0.2, 10, 0.05
"""A fit is refused when less of the image shows the map, or after so many evaluations; it ends with a step that moves
the image by less."""


@dataclass(frozen=True)
class PoseFit:
    """cam_from_world (4, 4) float64: the fitted pose, or the start where `converged` is False and `reason` says why.

    evaluations: how often the map was rendered; cost: mean |residual| per pixel seen, at the last evaluation.
    """

    cam_from_world: Tensor
    converged: bool
    reason: str
    evaluations: int
    cost: float


def track_gn(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    colors: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    image: Tensor,
    min_silhouette: float = 0.95,
) -> PoseFit:
    """Fit cam_from_world (4, 4) so that the map looks like image (H, W, 3) in 0..1.

    Minimises Σ |C - I| over the pixels with silhouette >= min_silhouette. Ends when a step moves the image by less than
    TOLERANCE_PX; refuses, with `converged` False, if less than MIN_OVERLAP of the image shows the map, if the cost
    grows or if MAX_EVALUATIONS do not suffice. Computes in float32 on the CPU wherever the tensors are. Raises
    ValueError for NaN, infinity or wrong shapes.
    """
    problem = _Problem(means, radii, opacities, colors, intrinsics, image)
    start = cam_from_world.detach().cpu().double()
    require_finite("cam_from_world", start)
    pose, floor, first_cost, cost = start, FIRST_FLOOR, np.inf, np.inf
    reason, evaluation = f"no convergence within {MAX_EVALUATIONS} evaluations", 0
    for evaluation in range(1, MAX_EVALUATIONS + 1):
        information, gradient, total, pixels, z = problem.normal_equations(pose, floor, min_silhouette)
        if pixels < MIN_OVERLAP * intrinsics.width * intrinsics.height:
            reason = f"only {pixels} pixels show the map, fewer than {MIN_OVERLAP:.0%} of the image"
            break
        cost = total / pixels
        first_cost = min(first_cost, cost) if evaluation == 1 else first_cost
        if np.linalg.cond(information) > 1e12:
            reason = "the image does not determine the pose"
            break
        step = torch.from_numpy(-np.linalg.solve(information, gradient))
        pose = se3.exp(step) @ pose
        step_px = max(intrinsics.fx, intrinsics.fy) * float(step[:3].norm() / z + step[3:].norm())
        if step_px < TOLERANCE_PX:
            reason = "" if cost <= first_cost else "the cost grew"
            break
        floor = max(floor * FLOOR_FACTOR, LAST_FLOOR)
    return PoseFit(start if reason else pose, not reason, reason, evaluation, float(cost))


class _Problem:
    """The arguments of `track_gn` as checked arrays, and how to evaluate them at a pose."""

    def __init__(
        self,
        means: Tensor,
        radii: Tensor,
        opacities: Tensor,
        colors: Tensor,
        intrinsics: Intrinsics,
        image: Tensor,
    ) -> None:
        self.intrinsics, count = intrinsics, len(means)
        self.means = _checked("means", means, (count, 3))
        self.radii = _checked("radii", radii, (count,))
        self.opacities = _checked("opacities", opacities, (count,)).numpy()
        self.colors = _checked("colors", colors, (count, 3)).numpy()
        self.image = _checked("image", image, (intrinsics.height, intrinsics.width, 3)).numpy()

    def normal_equations(
        self, pose: Tensor, floor: float, min_silhouette: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float, int, float]:
        """JᵀWJ, JᵀWr, cost, pixels, and the median depth of the Gaussians in front of the camera."""
        from .cpu_tracking import normal_equations  # imports numba

        points_in_cam = se3.transform(pose.float(), self.means)
        u, v, sigma_px, z = project_gaussians(points_in_cam, self.radii, self.intrinsics, NEAR)
        front = z[z > NEAR]
        projected = (u.numpy(), v.numpy(), sigma_px.numpy(), z.contiguous().numpy(), self.opacities)
        focal = (self.intrinsics.fx, self.intrinsics.fy)
        result = normal_equations(
            projected, points_in_cam.numpy(), self.colors, self.image, focal, floor, min_silhouette, NEAR
        )
        return (*result, float(front.median()) if len(front) else 1.0)


def _checked(name: str, tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
    tensor = tensor.detach().to("cpu", torch.float32).contiguous()
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name}: got shape {tuple(tensor.shape)}, expected {shape}")
    require_finite(name, tensor)
    return tensor
