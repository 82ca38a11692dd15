"""Growth of the map: seeds where a view finds holes, densification where it is wrong, pruning of useless Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, reduce

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..config import MappingConfig
from ..render.api import Rendering
from ..render.gaussian_map import GaussianMap
from ..render.rules import GaussianStats
from ..system.parallel import LruSequence
from ..types import Intrinsics
from .state import OptimiserState
from .views import View

SEED_STRIDE = 2
"""Pixels between two new Gaussians where the map has a hole."""
SEED_OPACITY = 0.73
"""Opacity (0..1) of a seed of an empty map."""
SEED_RADIUS = 0.7
"""Radius of a seed in units of the distance between seeds on the image: neighbours then overlap without blurring."""
SEED_LOGIT = 3.0
"""Logit of a seed's own class against 0 for the others."""
MIN_DETAIL = 8.0
"""Range of colours (of 255) in 3 x 3 pixels below which there is no detail."""


class Seeding(Enum):
    """Pixels that a step seeds before it renders: none, those of trusted depth, or all remaining holes."""

    NOTHING = 0
    TRUSTED = 1
    REST = 2


def complete_depth(
    depth: NDArray[np.float32], trust: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A depth and trust for every pixel of (H, W), 0 = unknown: what is unknown is filled from around it, and not
    trusted."""
    known = depth > 0
    if not known.any():
        return np.zeros_like(depth), np.zeros_like(depth)
    inverse, trust = np.divide(1, depth, out=np.zeros_like(depth), where=known), np.where(known, trust, 0)
    filled = np.where(known, inverse, fill_smoothly(inverse, trust))
    return (1.0 / np.maximum(filled, 1e-9)).astype(np.float32), trust


def fill_smoothly(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) a smooth continuation of the values > 0: coarser and coarser weighted means until all is covered."""
    known = np.where(values > 0, np.maximum(weights, 1e-3), 0).astype(np.float32)
    levels = [(values * known, known)]
    while min(levels[-1][0].shape) > 2:
        total, weight = (cv2.pyrDown(a).astype(np.float32) for a in levels[-1])
        levels.append((total, weight))
    filled = np.full_like(levels[-1][0], float(levels[-1][0].sum() / max(levels[-1][1].sum(), 1e-12)))
    for total, weight in reversed(levels):
        coarse = cv2.resize(filled, total.shape[::-1], interpolation=cv2.INTER_LINEAR)
        share = np.clip(weight / 0.05, 0, 1)
        mean = np.divide(total, weight, out=coarse.copy(), where=weight > 1e-6)
        filled = share * mean + (1 - share) * coarse
    return filled


def seed_gaussians(
    pixels: Tensor,
    depth: Tensor,
    colors: Tensor,
    channels: Tensor,
    spacing: float | Tensor,
    classes: int,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    frame_id: int,
) -> GaussianMap:
    """One Gaussian for each marked pixel with a depth.

    pixels (H, W) bool, depth (H, W), colors (H, W, 3) 0..1, channels (H, W) uint8, spacing: pixels between neighbours,
    one number or (H, W).
    """
    rows, columns = torch.nonzero(pixels & (depth > 0), as_tuple=True)
    z = depth[rows, columns]
    x = (columns + 0.5 - intrinsics.cx) / intrinsics.fx * z
    y = (rows + 0.5 - intrinsics.cy) / intrinsics.fy * z
    world_from_cam = torch.linalg.inv(cam_from_world).to(z.device)
    in_world = torch.stack([x, y, z], 1).double() @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    focal = math.sqrt(intrinsics.fx * intrinsics.fy)
    if isinstance(spacing, Tensor):
        spacing = spacing[rows, columns]
    channel = channels[rows, columns].long()
    logits = torch.zeros(len(z), classes + 1, device=z.device)
    # Void pixels write into a column of their own, which is cut off.
    logits[torch.arange(len(z), device=z.device), channel.clamp(max=classes)] = SEED_LOGIT
    return GaussianMap(
        means=in_world.float(),
        log_radii=torch.log(z / focal * (spacing * SEED_RADIUS)),
        opacity_logits=torch.full_like(z, math.log(SEED_OPACITY / (1 - SEED_OPACITY))),
        colors=colors[rows, columns].float(),
        class_logits=logits[:, :classes].contiguous(),
        anchor_frame_ids=torch.full((len(z),), frame_id, dtype=torch.int64, device=z.device),
    )


def seed_spacing(
    image: NDArray[np.uint8], depth: NDArray[np.float32], stride: int, fine_share: float, flat_share: float
) -> NDArray[np.float32]:
    """(H, W) where to seed: the distance in pixels to the next seed, 0 = no seed here.

    image (H, W, 3), depth (H, W). A seed every `stride` pixels; one every pixel in the `fine_share` of the
    cells with the most detail, one every 2 * stride in the `flat_share` with the least. Depth steps are never flat.
    Shares instead of thresholds: what counts as detail depends on the noise of the camera.
    """
    height, width = depth.shape
    out = np.zeros((height, width), np.float32)
    out[seed_grid(height, width, stride)] = stride
    detail = _detail(image)
    if flat_share > 0:
        side = 2 * stride
        flat = _cells(detail, side) <= np.quantile(detail[::2, ::2], flat_share)
        flat &= ~_cells(_steps(depth), side).astype(bool)
        _refill(out, flat, side, float(side), side // 2)
    if fine_share > 0 and stride > 1:
        cells = _cells(detail, stride)
        fine = cells > max(float(np.quantile(cells, 1 - fine_share)), MIN_DETAIL)
        _refill(out, fine, stride, 1.0, None)
    return out


def _detail(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W) range of the colours around every pixel, 0..255, after a slight blur that takes the camera's noise."""
    soft = cv2.GaussianBlur(image, (0, 0), 0.7)
    square = np.ones((3, 3), np.uint8)
    return (cv2.dilate(soft, square).astype(np.float32) - cv2.erode(soft, square)).max(-1)


def _steps(depth: NDArray[np.float32], tolerance: float = 0.04) -> NDArray[np.float32]:
    """(H, W) 1 beside a depth step or where the depth is unknown."""
    square = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, square), cv2.dilate(depth, square)
    return (high - low > tolerance * high).astype(np.float32)


def _cells(values: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """(ceil(H / side), ceil(W / side)) largest value in each square."""
    height, width = values.shape
    padded = np.pad(values, ((0, -height % side), (0, -width % side)), mode="edge")
    return reduce(np.maximum, (padded[i::side, j::side] for i in range(side) for j in range(side)))


def _refill(out: NDArray[np.float32], cells: NDArray[np.bool_], side: int, spacing: float, middle: int | None) -> None:
    """In the marked cells: one seed in the middle, or (None) one at every pixel."""
    height, width = out.shape
    inside = np.repeat(np.repeat(cells, side, axis=0), side, axis=1)[:height, :width]
    if middle is None:
        out[inside] = spacing
        return
    out[inside] = 0
    grid = np.zeros_like(inside)
    grid[middle::side, middle::side] = True
    out[inside & grid] = spacing


def seed_grid(height: int, width: int, stride: int) -> NDArray[np.bool_]:
    """(H, W) every stride-th pixel of every stride-th row, centred in its cell."""
    grid = np.zeros((height, width), bool)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    return grid


CHILDREN = 4
"""Gaussians in the place of one that is split."""
CHILD_RADIUS, CHILD_OFFSET = 0.55, 0.6
"""Radius of a child and distance from the parent's centre along both tangents, in radii of the parent: the children
cover together what it covered, and a little less reaches over its rim."""
_NEIGHBOURS = 12
"""Gaussians around a parent, itself included, to which the plane of its surface is fitted."""

GROWN_OPACITY = 0.3
"""Opacity (0..1) of Gaussians added to a map that is there: opaque ones would hide what has been learnt."""
LOW_RELIABILITY, HIGH_RELIABILITY = 0.35, 0.85
"""Reliability U (0..1) of a depth: up to the first it is low, above the second high (τ of MSGS-SLAM 3.1)."""
FINE_SHARE, FLAT_SHARE = 0.25, 0.5
"""Shares of a view: that of most detail gets a new Gaussian at every pixel, that of least detail twice as far apart."""
HOLE = 0.55
"""T_sil, a silhouette (0..1): a pixel of less is a hole."""
DEPTH_TOLERANCE = 0.05
"""T_depth, relative to the proxy's depth: where that is nearer than the map by more, Gaussians are added."""
SPLIT_RADIUS = 1.0
"""Radius on the image, in pixels: a Gaussian that is smaller in a view has no share of that view's errors."""
SPLIT_ERROR = 0.1
"""Share of the colour errors (0..1) of a view's pixels, summed: Gaussians of more are split."""
PRUNE_OPACITY, PRUNE_WEIGHT, PRUNE_RADIUS = 0.03, 0.05, 0.15
"""Gaussians go that are more transparent than this, of less blending weight in every pixel of every visit of a pass (a
fifth fewer at +0.06 dB), or larger than this in units of the scene's median depth."""
SPACINGS_ROOM = 50e6
"""Bytes of seed distances that are kept."""
_SOLID = 0.8
"""Silhouette (0..1) above which the map knows the depth of a pixel."""


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
        pixels, depth, trust = self._spacings[index] > 0, view.depth, view.trust
        if rendering is not None and what is Seeding.TRUSTED:
            pixels &= self._needed(view, rendering)
        elif rendering is not None:  # completed from what the other views have put into the map around the holes
            pixels &= rendering.silhouette < HOLE
            known = (rendering.silhouette > _SOLID) & (trust < HIGH_RELIABILITY)
            depth = torch.where(known, rendering.depth, depth)
            trust = torch.where(known, trust.clamp(min=2 * LOW_RELIABILITY), trust)
        completed = complete_depth(depth.cpu().numpy(), trust.cpu().numpy())
        depth, trust = (torch.from_numpy(x).to(view.image.device) for x in completed)
        if what is Seeding.TRUSTED:
            pixels &= trust > LOW_RELIABILITY
        self._append(index, pixels, depth, trust, SEED_OPACITY)

    @torch.no_grad()
    def grow(self, index: int, rendering: Rendering) -> None:
        """Add Gaussians by the conditions of the paper, at the proxy's depth where it is reliable, else at the map's
        own."""
        view = self.views[index]
        # A trusted proxy is sharp at depth edges, where the map's blended depth lies between the surfaces.
        nearer = hidden_surfaces(rendering.depth, view.depth, view.trust)
        use_map = (rendering.silhouette > _SOLID) & ~nearer & (view.trust < HIGH_RELIABILITY)
        proxy = torch.where(view.trust > LOW_RELIABILITY, view.depth, 0.0)
        depth = torch.where(use_map, rendering.depth, proxy)
        trust = torch.where(use_map, LOW_RELIABILITY, view.trust)
        pixels = self._needed(view, rendering) & (self._spacings[index] > 0)
        self._append(index, pixels, depth, trust, GROWN_OPACITY, weight=1.0)

    @torch.no_grad()
    def note(self, stats: GaussianStats, rows: Tensor | None, footprints: Tensor) -> None:
        """Note what a view says of some rows, None for all: a Gaussian answers for errors (Rota Bulò, Porzi and
        Kontschieder, "Revising Densification in Gaussian Splatting", ECCV 2024) where it is large enough to be split.
        """
        found = torch.stack([stats.largest, torch.where(footprints > SPLIT_RADIUS, stats.error_share, 0.0)], 1)
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
        views, stride = self.views, SEED_STRIDE
        return LruSequence(len(views), lambda i: _spacing(views[i], stride), lambda t: t.nbytes, SPACINGS_ROOM)

    def _needed(self, view: View, rendering: Rendering) -> Tensor:
        """(H, W) conditions (a), the map does not cover the pixel, and (b)."""
        return (rendering.silhouette < HOLE) | hidden_surfaces(rendering.depth, view.depth, view.trust)

    def _append(
        self, index: int, pixels: Tensor, depth: Tensor, trust: Tensor, opacity: float, weight: float = 0.0
    ) -> None:
        parameters, view = self.state.parameters, self.views[index]
        pixels = pixels & (depth > 0)
        if not pixels.any() or len(parameters) >= self.settings.max_gaussians:
            return
        pose, spacing = self.state.cam_from_world(index, view), self._spacings[index].float()
        seeds = seed_gaussians(
            pixels, depth, view.colors, view.channels, spacing, self.classes, pose, view.intrinsics, view.frame_id
        )
        seeds.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        parameters.append(seeds, trust[pixels], weight)


def _spacing(view: View, stride: int) -> Tensor:
    image, depth = view.image.cpu().numpy(), view.depth.cpu().numpy()
    spacing = seed_spacing(image, depth, stride, FINE_SHARE, FLAT_SHARE).astype(np.uint8)
    return view.of_scene(torch.from_numpy(spacing).to(view.image.device), 0)


def hidden_surfaces(rendered: Tensor, proxy: Tensor, trust: Tensor) -> Tensor:
    """(H, W) bool: condition (b), a trusted proxy is nearer than the map by more than DEPTH_TOLERANCE of its depth.

    The less the proxy is trusted, the larger the difference has to be.
    """
    allowed = DEPTH_TOLERANCE * proxy / trust.clamp(min=0.1)
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
