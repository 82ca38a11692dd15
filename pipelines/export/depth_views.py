"""What the finished map shows as depth: rendered median depth with a weight."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.depth.posed import PosedDepth
from pipelines.gaussian_map import GaussianMap
from pipelines.gaussians.render import median_depth, render
from pipelines.types import Intrinsics


@torch.no_grad()
def depth_view(gaussian_map: GaussianMap, cam_from_world: NDArray[np.float64], camera: Intrinsics) -> PosedDepth:
    """Median depth with a weight: none where the map is thin or the depth jumps, less far away."""
    m = gaussian_map
    pose = torch.as_tensor(cam_from_world, device=m.means.device)
    depth = median_depth(m.means, m.radii, m.opacities, pose, camera).cpu().numpy()
    silhouette = render(m.means, m.radii, m.opacities, m.colors, pose, camera).silhouette.cpu().numpy()
    solid = (silhouette > 0.7) & (depth > 0) & ~_jumps(depth)
    typical = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    # The error of a depth grows with its square.
    weight = np.where(solid, np.clip(typical / np.maximum(depth, 1e-9), 0.2, 1.5) ** 2 * silhouette, 0)
    return PosedDepth(camera, cam_from_world, depth.astype(np.float32), weight.astype(np.float32))


def _jumps(depth: NDArray[np.float32], tolerance: float = 0.08) -> NDArray[np.bool_]:
    """Pixels beside a step of the depth, where neither side can be trusted to a pixel."""
    out = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = np.moveaxis(depth, axis, 0)[:-1], np.moveaxis(depth, axis, 0)[1:]
        step = np.abs(a - b) > tolerance * np.minimum(a, b)
        view = np.moveaxis(out, axis, 0)
        view[:-1] |= step
        view[1:] |= step
    return out
