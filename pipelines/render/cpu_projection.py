"""World Gaussians to an image on CPUs (MSGS-SLAM eq. 5): one pass there and one back."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..system.threads import PART, as_array, for_each, fused_kernel, inner
from ..types import Intrinsics


def project(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """u, v, sigma_px, z (M,) as of `geometry.camera.project_gaussians`, of float32 Gaussians on the CPU seen from
    cam_from_world (4, 4), float32; differentiable in the first three. The same bytes for any number of threads."""
    return _Projected.apply(means, radii, cam_from_world, intrinsics, near)


class _Projected(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        k, near = arguments[3:]
        ctx.save_for_backward(*arguments[:3])
        ctx.camera = np.array([k.fx, k.fy, k.cx, k.cy, (k.fx * k.fy) ** 0.5, near], np.float32)
        given = [as_array(x) for x in arguments[:3]]
        out = np.empty((4, len(given[0])), np.float32)
        for_each(lambda part: _project(part * PART, *given, ctx.camera, out), -(-out.shape[1] // PART))
        return torch.from_numpy(out).unbind(0)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, radii, pose = (as_array(x) for x in ctx.saved_tensors)
        pull = [as_array(x) for x in gradients]
        d_means, d_radii, parts = np.empty_like(means), np.empty_like(radii), -(-len(means) // PART)
        d_pose = np.zeros((parts, 4, 4))
        for_each(
            lambda n: _pull_back(n * PART, means, radii, pose, ctx.camera, *pull, d_means, d_radii, d_pose[n]), parts
        )
        moved = torch.from_numpy(d_pose.sum(0).astype(np.float32)) if ctx.needs_input_grad[2] else None
        return torch.from_numpy(d_means), torch.from_numpy(d_radii), moved, None, None


@inner
def _in_camera(pose: NDArray[np.float32], center: NDArray[np.float32]) -> tuple[np.float32, np.float32, np.float32]:
    """The centre (3,) seen from cam_from_world (4, 4)."""
    a, b, c = center
    x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
    y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
    z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
    return x, y, z


@fused_kernel
def _project(
    start: int,
    means: NDArray[np.float32],
    radii: NDArray[np.float32],
    pose: NDArray[np.float32],
    camera: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Project one part, from Gaussian `start` on; camera: fx, fy, cx, cy, the mean of the focal lengths, near."""
    fx, fy, cx, cy, focal, near = camera
    one = np.float32(1)
    for i in range(start, min(start + PART, len(means))):
        x, y, z = _in_camera(pose, means[i])
        inverse = one / (z if z > near else one)
        out[0, i] = fx * (x * inverse) + cx
        out[1, i] = fy * (y * inverse) + cy
        out[2, i] = focal * (radii[i] * inverse)
        out[3, i] = z


@fused_kernel
def _pull_back(
    start: int,
    means: NDArray[np.float32],
    radii: NDArray[np.float32],
    pose: NDArray[np.float32],
    camera: NDArray[np.float32],
    pull_u: NDArray[np.float32],
    pull_v: NDArray[np.float32],
    pull_sigma: NDArray[np.float32],
    pull_z: NDArray[np.float32],
    d_means: NDArray[np.float32],
    d_radii: NDArray[np.float32],
    d_pose: NDArray[np.float64],
) -> None:
    """Gradients of one part by those of u, v, sigma_px and z; its share of the pose's is added in float64."""
    fx, fy, _, _, focal, near = camera
    one, none = np.float32(1), np.float32(0)
    for i in range(start, min(start + PART, len(means))):
        a, b, c = means[i]
        x, y, z = _in_camera(pose, means[i])
        inverse = one / (z if z > near else one)
        by_u, by_v, by_sigma = fx * pull_u[i], fy * pull_v[i], focal * pull_sigma[i]
        by_inverse = (by_u * x + by_v * y + by_sigma * radii[i]) * inverse * inverse
        d_radii[i] = by_sigma * inverse
        d_x, d_y = by_u * inverse, by_v * inverse
        d_z = pull_z[i] - (by_inverse if z > near else none)
        for k in range(3):
            d_means[i, k] = pose[0, k] * d_x + pose[1, k] * d_y + pose[2, k] * d_z
        d_pose[0, 0] += d_x * a
        d_pose[0, 1] += d_x * b
        d_pose[0, 2] += d_x * c
        d_pose[0, 3] += d_x
        d_pose[1, 0] += d_y * a
        d_pose[1, 1] += d_y * b
        d_pose[1, 2] += d_y * c
        d_pose[1, 3] += d_y
        d_pose[2, 0] += d_z * a
        d_pose[2, 1] += d_z * b
        d_pose[2, 2] += d_z * c
        d_pose[2, 3] += d_z
