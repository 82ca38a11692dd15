"""Growth of the map: seeds where a view finds holes, densification where it is wrong, pruning of useless Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..config import MappingConfig
from ..render.api import Rendering
from ..render.gaussian_map import GaussianMap
from ..render.notes import Notes
from ..system.parallel import LruSequence
from .schedule import Seeding
from .seeding import SEED_OPACITY, SeedDepth, complete_depth, seed_gaussians, seed_spacing
from .state import OptimiserState
from .views import View

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
"""Pixels: in a view where a Gaussian is smaller it answers for nothing."""
SPLIT_ERROR = 0.1
"""Colour error 0..1, summed over a view's pixels: Gaussians that answer for more are split."""
PRUNE_OPACITY, PRUNE_WEIGHT, PRUNE_RADIUS = 0.03, 0.05, 0.15
"""Gaussians go that are more transparent than this, of less blending weight in every pixel of every visit of a pass (a
fifth fewer at +0.06 dB), or larger than this in units of the scene's median depth."""
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
        """Fill the view's holes with Gaussians at its completed depth: the trusted ones, or the rest.

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
        self._append(index, needed & (spacing > 0), depth, trust, spacing, GROWN_OPACITY, weight=1.0)

    @torch.no_grad()
    def note(self, notes: Notes, rows: Tensor | None, footprints: Tensor) -> None:
        """Note what a view says of some rows, None for all: a Gaussian answers for errors (Rota Bulò, Porzi and
        Kontschieder, "Revising Densification in Gaussian Splatting", ECCV 2024) where it is large enough to be split.
        """
        found = torch.stack([notes.largest, torch.where(footprints > SPLIT_RADIUS, notes.answered, 0.0)], 1)
        noted = self.state.parameters.noted
        if rows is None:
            torch.maximum(noted, found, out=noted)
        else:
            noted.index_copy_(0, rows, torch.maximum(noted.index_select(0, rows), found))

    @torch.no_grad()
    def split(self) -> None:
        """Split the Gaussians that answer for the most error: as many as the map may hold."""
        parameters, s = self.state.parameters, self.settings
        wrong = parameters.noted[:, 1]
        room = max(s.max_gaussians - len(parameters), 0) // (CHILDREN - 1)
        rows = torch.argsort(wrong, descending=True, stable=True)[: min(int((wrong > SPLIT_ERROR).sum()), room)]
        if len(rows):
            children, trust = split(parameters.to_map(), rows), parameters.trust[rows].repeat(CHILDREN)
            kept = torch.ones(len(parameters), dtype=torch.bool, device=rows.device)
            kept[rows] = False
            parameters.keep(kept)
            parameters.append(children, trust, weight=1.0)

    @torch.no_grad()
    def prune(self, by_weight: bool) -> None:
        """Drop the Gaussians that are too transparent, too large or, `by_weight`, noted as of too little weight; what
        was noted is done with."""
        parameters = self.state.parameters
        bad = useless(parameters.to_map(), PRUNE_OPACITY, PRUNE_RADIUS * self.unit)
        if by_weight:
            bad |= parameters.noted[:, 0] < PRUNE_WEIGHT
        if bad.any():
            parameters.keep(~bad)
        parameters.noted.zero_()

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
        return complete_depth(view.depth.cpu().numpy(), view.trust.cpu().numpy())

    def _completed_by_map(self, view: View, rendering: Rendering) -> SeedDepth:
        """The view's depth, completed from what the other views have put into the map around its holes."""
        known = (rendering.silhouette > _SOLID) & (view.trust < HIGH_RELIABILITY)
        trust = torch.where(known, view.trust.clamp(min=2 * LOW_RELIABILITY), view.trust)
        depth = torch.where(known, rendering.depth, view.depth)
        return complete_depth(depth.cpu().numpy(), trust.cpu().numpy())

    def _append(
        self, index: int, pixels: Tensor, depth: Tensor, trust: Tensor, spacing: float | Tensor, opacity: float,
        weight: float = 0.0,
    ) -> None:  # fmt: skip
        parameters, view = self.state.parameters, self.views[index]
        pixels = pixels & (depth > 0)
        if not pixels.any() or len(parameters) >= self.settings.max_gaussians:
            return
        pose = self.state.cam_from_world(index, view)
        seeds = seed_gaussians(
            pixels, depth, view.colors, view.channels, spacing, self.classes, pose, view.intrinsics, view.frame_id
        )
        seeds.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        parameters.append(seeds, trust[pixels], weight)


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
