"""The map as a camera sees it, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..outcome import Exposure, labels_of_channels
from ..render.api import render
from ..render.gaussian_map import GaussianMap, decided_channels
from ..render.inspection import median_depth
from ..types import Intrinsics

_SEEN = 0.5
"""Less coverage than this is no surface: it has neither depth nor label."""


@dataclass(frozen=True)
class MapView:
    """color (H, W, 3) float32 0..1; depth (H, W) float32, unit of the world, 0 = nothing; labels (H, W) uint8 or VOID;
    coverage (H, W) float32 0..1."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]

    def exposed(self, exposure: Exposure | None, time: float) -> NDArray[np.uint8]:
        """(H, W, 3) image of the moment, with the exposure that the run found for it."""
        color = self.color if exposure is None else exposure.apply(self.color, time)
        return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)


@torch.no_grad()
def view_map(
    gaussian_map: GaussianMap,
    label_of_channel: NDArray[np.uint8],
    intrinsics: Intrinsics,
    cam_from_world: NDArray[np.float64],
) -> MapView:
    """Draw the map from `cam_from_world` (4, 4). The depth is that of the surface at which half the light is lost."""
    m = gaussian_map
    pose = torch.as_tensor(cam_from_world, dtype=torch.float64, device=m.means.device)
    features = torch.cat([m.colors, m.class_logits], dim=1)
    drawn = render(m.means, m.radii, m.opacities, features, pose, intrinsics)
    depth = median_depth(m.means, m.radii, m.opacities, pose, intrinsics).cpu().numpy()
    coverage = drawn.silhouette.cpu().numpy()
    channels = decided_channels(drawn.features[..., 3:]).cpu().numpy()
    return MapView(
        color=drawn.features[..., :3].clamp(0, 1).cpu().numpy().astype(np.float32),
        depth=np.where(coverage >= _SEEN, depth, 0).astype(np.float32),
        labels=labels_of_channels(np.where(coverage >= _SEEN, channels, -1), label_of_channel),
        coverage=coverage.astype(np.float32),
    )
