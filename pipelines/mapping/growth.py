"""Growth of the map: seeds where a view finds holes, densification where it is wrong, pruning of useless Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..config import MappingConfig
from ..render.api import Rendering
from ..render.gaussian_map import GaussianMap
from ..render.inspection import error_shares
from ..system.parallel import LruSequence
from ..types import VOID, Intrinsics
from .schedule import Seeding
from .seeding import SEED_OPACITY, SeedDepth, complete_depth, seed_gaussians, seed_spacing
from .state import OptimiserState
from .views import View

_MIN_REGION = 64
_REGION_SAMPLES = 4000

CHILDREN = 4
CHILD_RADIUS, CHILD_OFFSET = 0.55, 0.6
"""In radii of the parent: the children cover together what it covered, and a little less reaches over its rim."""
_NEIGHBOURS = 12
"""Gaussians around a parent, itself included, to which the plane of its surface is fitted."""

GROWN_OPACITY = 0.3
"""Of Gaussians added to a map that is already there: opaque ones would hide what has been learnt."""
LOW_RELIABILITY = 0.35
HIGH_RELIABILITY = 0.85
FINE_SHARE, FLAT_SHARE = 0.25, 0.5
"""Shares of a view: that of most detail gets a new Gaussian at every pixel, that of least detail twice as far apart."""
HOLE = 0.55
"""T_sil: less coverage than this is a hole."""
DEPTH_TOLERANCE = 0.05
"""T_depth, relative: a proxy nearer than the map by more adds Gaussians."""
SPLIT_RADIUS = 1.0
"""Pixels: smaller Gaussians are not split."""
SPLIT_ERROR = 0.1
"""Colour error 0..1, summed over a view's pixels: Gaussians that answer for more are split."""
PRUNE_OPACITY, PRUNE_WEIGHT, PRUNE_RADIUS = 0.03, 0.03, 0.15
"""Gaussians go that are more transparent than this, of less blending weight in every pixel of every keyframe (a fifth
fewer at +0.06 dB), or larger than this in units of the scene's median depth."""
SPACINGS_ROOM = 50e6
"""Bytes of seed distances that are kept."""
_SOLID = 0.8
"""Silhouette above which the map knows the depth of a pixel."""


@dataclass(frozen=True)
class Growth:
    """Adds to and takes from the map of `state`; `unit`: the scene's median depth."""

    views: Sequence[View]
    classes: int
    settings: MappingConfig
    state: OptimiserState
    unit: float

    @torch.no_grad()
    def seed(self, index: int, what: Seeding, rendering: Rendering | None) -> None:
        """Fill the view's holes with Gaussians at its completed depth (eq. 17): the trusted ones, or the rest.

        `rendering`: the map as the view sees it, None while there is none.
        """
        view = self.views[index]
        spacing = self._spacings[index].float()
        pixels = spacing > 0
        if rendering is None:
            completed = self._completed(index)
        else:
            pixels &= self._needed(view, rendering) if what is Seeding.TRUSTED else self._holes(rendering)
            completed = self._completed(index) if what is Seeding.TRUSTED else self._completed_by_map(view, rendering)
        depth, trust = (torch.from_numpy(x).to(view.image.device) for x in (completed.depth, completed.trust))
        if what is Seeding.TRUSTED:
            pixels &= trust > LOW_RELIABILITY
        self._append(index, pixels, depth, trust, spacing, SEED_OPACITY)

    @torch.no_grad()
    def grow(self, index: int, rendering: Rendering) -> None:
        """Add Gaussians by the conditions of the paper."""
        view = self.views[index]
        needed = self._needed(view, rendering)
        spacing = self._spacings[index].float()
        depth, trust = self._grown_depth(view, rendering)
        self._append(index, needed & (spacing > 0), depth, trust, spacing, GROWN_OPACITY)

    @torch.no_grad()
    def split(self, found: DensificationError) -> None:
        """Split the Gaussians that answer for the most error, where they are too large: as many as the map may hold."""
        parameters, s = self.state.parameters, self.settings
        wrong = torch.where(found.footprint > SPLIT_RADIUS, found.error, 0.0)
        room = max(s.max_gaussians - len(parameters), 0) // (CHILDREN - 1)
        rows = torch.argsort(wrong, descending=True, stable=True)[: min(int((wrong > SPLIT_ERROR).sum()), room)]
        if len(rows):
            children, trust = split(parameters.to_map(), rows), parameters.trust[rows].repeat(CHILDREN)
            kept = torch.ones(len(parameters), dtype=torch.bool, device=rows.device)
            kept[rows] = False
            parameters.keep(kept)
            parameters.append(children, trust)

    @torch.no_grad()
    def prune(self, largest_weight: Callable[[], Tensor] | None = None) -> None:
        """Drop the Gaussians that are too transparent, too large or of too low `largest_weight` (M,)."""
        parameters = self.state.parameters
        bad = useless(parameters.to_map(), PRUNE_OPACITY, PRUNE_RADIUS * self.unit)
        if largest_weight is not None:
            bad |= largest_weight() < PRUNE_WEIGHT
        if bad.any():
            parameters.keep(~bad)

    @cached_property
    def _spacings(self) -> LruSequence[Tensor]:
        """Of each view (H, W) uint8 distances in pixels to the next seed, 0 = no seed here; none in what is no part of
        the scene. Each is asked for twice as the map is seeded, and in every round of growth."""
        # Not a method: what is kept here would keep this, the views and the whole optimiser until garbage is collected.
        views, stride = self.views, self.settings.seed_stride
        return LruSequence(len(views), lambda i: _spacing(views[i], stride), lambda t: t.nbytes, SPACINGS_ROOM)

    def _holes(self, rendering: Rendering) -> Tensor:
        """Condition (a)."""
        return holes(rendering.silhouette, HOLE)

    def _needed(self, view: View, rendering: Rendering) -> Tensor:
        """Conditions (a) and (b)."""
        needed = self._holes(rendering)
        if self.settings.use_proxy_depth:
            needed = needed | hidden_surfaces(rendering.depth, view.depth, view.trust, DEPTH_TOLERANCE)
        return needed

    def _grown_depth(self, view: View, rendering: Rendering) -> tuple[Tensor, Tensor]:
        """(H, W) depth and trust: the proxy where it is reliable, else the map's own; 0 where neither knows."""
        # A trusted proxy is sharp at depth edges, where the map's blended depth lies between the surfaces.
        nearer = hidden_surfaces(rendering.depth, view.depth, view.trust, DEPTH_TOLERANCE)
        use_map = (rendering.silhouette > _SOLID) & ~nearer & (view.trust < HIGH_RELIABILITY)
        proxy = torch.where(view.trust > LOW_RELIABILITY, view.depth, 0.0)
        return torch.where(use_map, rendering.depth, proxy), torch.where(use_map, LOW_RELIABILITY, view.trust)

    def _completed(self, index: int) -> SeedDepth:
        view = self.views[index]
        return self._complete(view, view.depth, view.trust)

    def _completed_by_map(self, view: View, rendering: Rendering) -> SeedDepth:
        """The view's depth, completed from what the other views have put into the map around its holes."""
        known = (rendering.silhouette > _SOLID) & (view.trust < HIGH_RELIABILITY)
        trust = torch.where(known, view.trust.clamp(min=2 * LOW_RELIABILITY), view.trust)
        return self._complete(view, torch.where(known, rendering.depth, view.depth), trust)

    def _complete(self, view: View, depth: Tensor, trust: Tensor) -> SeedDepth:
        arrays = depth.cpu().numpy(), trust.cpu().numpy(), view.channels.cpu().numpy()
        return complete_depth(*with_region_prior(*arrays, LOW_RELIABILITY))

    def _append(
        self, index: int, pixels: Tensor, depth: Tensor, trust: Tensor, spacing: float | Tensor, opacity: float
    ) -> None:
        parameters, view = self.state.parameters, self.views[index]
        pixels = pixels & (depth > 0)
        if not pixels.any() or len(parameters) >= self.settings.max_gaussians:
            return
        pose = self.state.cam_from_world(index, view)
        seeds = seed_gaussians(
            pixels, depth, view.colors, view.channels, spacing, self.classes, pose, view.intrinsics, view.frame_id
        )
        seeds.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        parameters.append(seeds, trust[pixels])


def _spacing(view: View, stride: int) -> Tensor:
    image, depth = view.image.cpu().numpy(), view.depth.cpu().numpy()
    spacing = seed_spacing(image, depth, stride, FINE_SHARE, FLAT_SHARE).astype(np.uint8)
    return view.of_scene(torch.from_numpy(spacing).to(view.image.device), 0)


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


def with_region_prior(
    depth: NDArray[np.float32], trust: NDArray[np.float32], channels: NDArray[np.uint8], low: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depth, 0 = unknown, and trust (H, W), in which pixels trusted up to `low` have the depth of their region.

    A region is connected and of one class in channels (H, W); μ_k of eq. (17) is a plane in inverse depth over it, so
    that slanted walls keep their slant.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    out, out_trust = inverse.copy(), np.where(depth > 0, trust, 0).astype(np.float32)
    trust = out_trust.copy()
    for channel in np.unique(channels[channels != VOID]):
        mask = (channels == channel).astype(np.uint8)
        _, regions, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        for region in 1 + np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= _MIN_REGION):
            left, top, width, height = boxes[region, : cv2.CC_STAT_AREA]
            rows, columns = np.nonzero(regions[top : top + height, left : left + width] == region)
            rows, columns = rows + top, columns + left
            weak = trust[rows, columns] <= low
            reliable = ~weak & (inverse[rows, columns] > 0)
            if not weak.any() or reliable.sum() < _MIN_REGION:
                continue
            mean, spread = _fit_plane(columns, rows, inverse[rows, columns], reliable)
            rows, columns, mean = rows[weak], columns[weak], mean[weak]
            seen, weight = inverse[rows, columns], trust[rows, columns]
            # The proxy's own precision at reliability U is taken as U² / 5 %²; the prior's is its residual spread.
            proxy_precision = np.where(seen > 0, (weight / (0.05 * np.maximum(seen, 1e-9))) ** 2, 0)
            prior_precision = 1 / max(spread, 1e-9) ** 2
            fused = (proxy_precision * seen + prior_precision * mean) / (proxy_precision + prior_precision)
            good = (mean > 0) & (spread < 0.1 * mean)
            out[rows[good], columns[good]] = fused[good]
            out_trust[rows[good], columns[good]] = np.maximum(weight[good], low / 2)
    return out, out_trust


def _fit_plane(
    columns: NDArray, rows: NDArray, values: NDArray[np.float32], use: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], float]:
    """Robust plane a x + b y + c through the used values, at all places, and the spread of its residuals."""
    picked = np.flatnonzero(use)
    picked = picked[:: max(len(picked) // _REGION_SAMPLES, 1)]
    design = np.stack([columns, rows, np.ones(len(rows))], 1) / [1000, 1000, 1]
    target, weights = values[picked].astype(np.float64), np.ones(len(picked))
    for _ in range(5):
        a = design[picked] * weights[:, None]
        plane = np.linalg.lstsq(a, target * weights, rcond=None)[0]
        residual = np.abs(design[picked] @ plane - target)
        spread = 1.4826 * float(np.median(residual))
        weights = np.sqrt(1 / np.maximum(residual / max(spread, 1e-9), 1))
    return (design @ plane).astype(np.float32), spread
