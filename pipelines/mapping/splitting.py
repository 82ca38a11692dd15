"""Splitting Gaussians that are too large for what they show: four smaller ones, side by side on the surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..gaussian_map import GaussianMap
from ..gaussians.render import error_shares
from ..types import Intrinsics

CHILDREN = 4
CHILD_RADIUS, CHILD_OFFSET = 0.55, 0.6
"""In radii of the parent: the children cover together what it covered, and a little less reaches over its rim."""
_NEIGHBOURS = 12
"""Gaussians around a parent, itself included, to which the plane of its surface is fitted."""


@dataclass(frozen=True)
class DensificationError:
    """Error of each Gaussian in the worst of several views: `error` (M,) in pixels times colour error, and `footprint`
    (M,), its radius on that image in pixels."""

    error: Tensor
    footprint: Tensor

    def worst_of(self, other: DensificationError) -> DensificationError:
        """For each Gaussian the view of larger error."""
        worse = other.error > self.error
        return DensificationError(
            torch.where(worse, other.error, self.error), torch.where(worse, other.footprint, self.footprint)
        )


@torch.no_grad()
def densification_error(
    gaussian_map: GaussianMap, cam_from_world: Tensor, intrinsics: Intrinsics, error_of: Callable[[Tensor], Tensor]
) -> DensificationError:
    """Compute the error of each Gaussian in one view: the errors of the pixels, weighted by its share in them, summed.

    `error_of`: (H, W, 3) colours of the map to (H, W) errors (the error of Rota Bulò, Porzi and Kontschieder, "Revising
    Densification in Gaussian Splatting", ECCV 2024).
    """
    m = gaussian_map
    return DensificationError(
        *error_shares(m.means, m.radii, m.opacities, m.colors, cam_from_world, intrinsics, error_of)
    )


def split(gaussian_map: GaussianMap, rows: Tensor) -> GaussianMap:
    """Four children in place of each of the given rows (n,), in a square in the plane of the map around the parent."""
    first, second = _tangents(gaussian_map.means.cpu().numpy(), rows.cpu().numpy())
    along, across = (torch.from_numpy(t).to(gaussian_map.means) for t in (first, second))
    reach = CHILD_OFFSET * gaussian_map.radii[rows, None]
    means = [gaussian_map.means[rows] + reach * (a * along + b * across) for a in (1, -1) for b in (1, -1)]
    four = rows.repeat(CHILDREN)
    return GaussianMap(
        means=torch.cat(means),
        log_radii=gaussian_map.log_radii[four] + math.log(CHILD_RADIUS),
        opacity_logits=gaussian_map.opacity_logits[four],
        colors=gaussian_map.colors[four],
        class_logits=gaussian_map.class_logits[four],
        anchor_frame_ids=gaussian_map.anchor_frame_ids[four],
    )


def _tangents(means: NDArray[np.float32], rows: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors (n, 3) each along the surface: the two main directions of the nearest Gaussians."""
    _, nearest = cKDTree(means).query(means[rows], k=min(_NEIGHBOURS, len(means)))
    around = means[nearest.reshape(len(rows), -1)].astype(np.float64)
    around -= around.mean(1, keepdims=True)
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return directions[:, :, 2], directions[:, :, 1]
