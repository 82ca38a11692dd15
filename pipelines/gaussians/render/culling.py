"""Which Gaussians an image may show: of a long recording's map a view sees a small part."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry import se3
from ...geometry.camera import project_gaussians
from ...types import Intrinsics
from . import cards, rules
from .compositing import require_finite
from .jit import kernel
from .threads import PART, for_each

NEAR = 0.01
"""Gaussians whose centre is nearer than this (or behind the camera) are not drawn; in the unit of the map."""


@torch.no_grad()
def in_view(means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR) -> Tensor:
    """(n,) indices of the Gaussians whose square reaches the image, a pixel to spare: no others take part in it."""
    for name, tensor in (("means", means), ("radii", radii)):
        require_finite(name, tensor)
    k, pose = intrinsics, cam_from_world.to(means)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        camera = np.array([k.fx, k.fy, k.cx, k.cy, k.width, k.height, near], np.float32)
        centers, sizes, motion = (x.detach().contiguous().numpy() for x in (means, radii, pose))
        parts = -(-len(centers) // PART)
        found = [np.empty(0, np.int64)] * parts

        def find(part: int) -> None:
            own = slice(part * PART, (part + 1) * PART)
            found[part] = _list_in_view(centers[own], sizes[own], motion, camera, own.start)

        for_each(find, parts)
        return torch.from_numpy(np.concatenate([np.empty(0, np.int64), *found]))
    if cards.takes_kernels(means):
        return torch.nonzero(marked_in_view(means, radii, pose, k, near))[:, 0]
    u, v, sigma_px, z = project_gaussians(se3.transform(pose, means), radii, k, near)
    reach = rules.CUT_SIGMAS * sigma_px + 1
    seen = (z > near) & (u > -reach) & (u < k.width + reach) & (v > -reach) & (v < k.height + reach)
    return torch.nonzero(seen)[:, 0]


def marked_in_view(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR
) -> Tensor:
    """(M,) bool: which are `in_view`, of tensors of one card; unlike a list it keeps nobody waiting for its length."""
    from .cuda_projection import mark_in_view  # imports triton

    return mark_in_view(means, radii, cam_from_world.to(means), intrinsics, near)


@kernel
def _list_in_view(
    means: NDArray[np.float32], radii: NDArray[np.float32], pose: NDArray[np.float32], camera: NDArray[np.float32],
    start: int,
) -> NDArray[np.int64]:  # fmt: skip
    """See `in_view`; camera: fx, fy, cx, cy, width, height, near; the first of these is Gaussian number `start`."""
    fx, fy, cx, cy, width, height, near = camera
    focal = np.sqrt(fx * fy) * np.float32(rules.CUT_SIGMAS)
    out, count = np.empty(len(means), np.int64), 0
    for i in range(len(means)):
        x, y, z = means[i]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if depth > near:
            # All lengths times the depth: nothing is divided.
            reach = focal * radii[i] + depth
            u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) + cx * depth
            v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) + cy * depth
            if u > -reach and v > -reach and u < width * depth + reach and v < height * depth + reach:
                out[count] = start + i
                count += 1
    return out[:count].copy()
