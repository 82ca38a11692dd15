"""Semantic Gaussians, as the paper optimises them, and what a camera sees of them (section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.camera import project_gaussians
from ..geometry.se3 import transform
from ..mapping.growth import SEED_LOGIT
from ..mapping.views import View
from ..render.api import NEAR, Rendering, depth_ratio, in_view, render
from ..render.gaussian_map import GaussianMap
from ..render.rules import ALPHA_MAX, ALPHA_MIN, CUT_SIGMAS
from ..system.adam import AdamTable
from ..types import VOID, Intrinsics


def density(points: Tensor, mean: Tensor, radius: Tensor, opacity: Tensor) -> Tensor:
    """Eq. (4): f(x) = σ exp(-‖x - μ‖² / 2r²) of one isotropic Gaussian at points (..., 2 or 3)."""
    return opacity * torch.exp(-(points - mean).square().sum(-1) / (2 * radius * radius))


def projection(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics
) -> tuple[Tensor, Tensor, Tensor]:
    """Eq. (5): μ²ᴰ = K E μ / d (M, 2), r²ᴰ = f r / d (M,) and d = (E μ)_z (M,) of means (M, 3) and radii (M,)."""
    u, v, radius, depth = project_gaussians(transform(cam_from_world.to(means), means), radii, intrinsics, NEAR)
    return torch.stack([u, v], 1), radius, depth


def occluder_weight(depth: Tensor, proxy: Tensor, kappa: float) -> Tensor:
    """w_d(d, D̂) = exp(-κ|d - D̂|²) of Eq. (7): an occluder that disagrees with the proxy hides less; 1 without one."""
    return torch.where(proxy > 0, torch.exp(-kappa * (depth - proxy).square()), torch.ones_like(depth))


def draw_semantics(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    features: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    twist: Tensor | None = None,
    proxy: Tensor | None = None,
    kappa: float = 0.0,
) -> Rendering:
    """Eqs. (6) to (9) for every pixel, by the compiled renderer: features are colours (M, 3) beside semantics.

    The depth is that of Eq. (7) over its own weights. With κ > 0 it comes from the renderer in plain torch, where
    proxy (H, W) says which occluders to believe.
    """
    seen = render(means, radii, opacities, features, cam_from_world, intrinsics, twist)
    if kappa == 0 or proxy is None:
        return seen
    return Rendering(
        seen.features,
        weighted_depth(means, radii, opacities, cam_from_world, intrinsics, proxy, kappa),
        seen.silhouette,
    )


def weighted_depth(
    means: Tensor, radii: Tensor, opacities: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, proxy: Tensor,
    kappa: float,
) -> Tensor:  # fmt: skip
    """Eq. (7) over the image, (H, W), divided by its weights: differentiable in means, radii and opacities."""
    rows = in_view(means, radii, cam_from_world, intrinsics)
    centers, radius, depth = projection(means[rows], radii[rows], cam_from_world, intrinsics)
    (u, v), width, height = centers.unbind(1), intrinsics.width, intrinsics.height
    pairs = pixel_pairs(u, v, radius, depth, opacities[rows], width, height, NEAR)
    f, d = pair_opacities(pairs, u, v, radius, depth, opacities[rows], width)
    hidden = f * occluder_weight(d, proxy.reshape(-1)[pairs.pixel], kappa)
    weights = f * transmittance_before(hidden, pairs)
    sums = [torch.zeros(height * width).to(d).index_add(0, pairs.pixel, x) for x in (weights * d, weights)]
    return depth_ratio(*sums).view(height, width)


@dataclass(frozen=True)
class Pairs:
    """P pairs, pixel by pixel in raster order, near to far within a pixel: gaussian (P,) and pixel (P,) indices;
    pixel_ends (H*W + 1,): where each pixel's pairs start and end."""

    gaussian: Tensor
    pixel: Tensor
    pixel_ends: Tensor


def pixel_pairs(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float
) -> Pairs:
    """List which Gaussian reaches which pixel: rows that each crosses, the pixels of each row, then a stable sort."""
    u, v, sigma_px, z, opacity = (x.detach() for x in (u, v, sigma_px, z, opacity))
    reach = (2 * torch.log((opacity / ALPHA_MIN).clamp(min=1.0))).clamp(max=CUT_SIGMAS**2).sqrt() * sigma_px
    seen = (z > near) & (reach > 0) & (u + reach >= 0.5) & (u - reach <= width - 0.5)
    order = torch.nonzero(seen & (v + reach >= 0.5) & (v - reach <= height - 0.5))[:, 0]
    order = order[torch.argsort(z[order], stable=True)]
    u, v, reach = u[order], v[order], reach[order]
    of_row, row = _ranges((v - reach - 0.5).ceil().clamp(min=0), (v + reach - 0.5).floor().clamp(max=height - 1))
    half = (reach[of_row] ** 2 - (row + 0.5 - v[of_row]) ** 2).clamp(min=0).sqrt()
    left, right = u[of_row] - half - 0.5, u[of_row] + half - 0.5
    of_pair, column = _ranges(left.ceil().clamp(min=0), right.floor().clamp(max=width - 1))
    pixel, permutation = torch.sort(row[of_pair] * width + column, stable=True)
    return Pairs(order[of_row[of_pair]][permutation], pixel, ends_of(pixel, width * height))


def pair_opacities(
    pairs: Pairs, u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int
) -> tuple[Tensor, Tensor]:
    """f and d of every pair, (P,) each."""
    table = torch.stack([u, v, sigma_px, z, opacity], dim=1)
    u, v, sigma_px, depth, opacity = table.index_select(0, pairs.gaussian).unbind(1)
    dx = pairs.pixel % width + 0.5 - u
    dy = torch.div(pairs.pixel, width, rounding_mode="floor") + 0.5 - v
    alpha = opacity * torch.exp(-0.5 * (dx * dx + dy * dy) / (sigma_px * sigma_px))
    return alpha.clamp(max=ALPHA_MAX), depth


def transmittance_before(occlusion: Tensor, pairs: Pairs) -> Tensor:
    """(P,) the light that reaches each pair: product of 1 - occlusion of the nearer pairs of its pixel."""
    # One running sum over the whole image: float32 would lose the digits of the late pixels.
    total = torch.cumsum(torch.log1p(-occlusion.double()), 0)
    exclusive = torch.cat([total.new_zeros(1), total])
    starts = pairs.pixel_ends[:-1]
    at_pixel_start = exclusive.index_select(0, starts).repeat_interleave(pairs.pixel_ends.diff())
    return torch.exp(exclusive[:-1] - at_pixel_start).to(occlusion.dtype)


def _ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Lists first[i]..last[i] for every i: (index i, number), empty where last < first."""
    first = first.long()
    counts = (last.long() - first + 1).clamp(min=0)
    index = torch.repeat_interleave(torch.arange(len(first), device=first.device), counts)
    starts = torch.cumsum(counts, 0) - counts
    return index, torch.arange(len(index), device=first.device) - starts[index] + first[index]


def ends_of(index: Tensor, count: int) -> Tensor:
    """(count + 1,) where the runs of 0 .. count - 1 in an index start and end, once it is sorted."""
    return torch.cat([index.new_zeros(1), torch.cumsum(torch.bincount(index, minlength=count), 0)])


KEYS = ("means", "log_radii", "opacity_logits", "colors", "class_logits")


@dataclass
class Gaussians:
    """A Gaussian map with Adam's moments; anchors (M,) frame ids. Semantic vectors s_i are class_logits / 3: of a seed
    1 for its class and 0 for the others."""

    table: AdamTable
    anchors: Tensor
    trust: Tensor

    @staticmethod
    def of(gaussian_map: GaussianMap, trust: Tensor | None = None) -> Gaussians:
        """With fresh moments; trust (M,): U of the depth that each was seeded at, 1 where None."""
        trust = torch.ones_like(gaussian_map.log_radii) if trust is None else trust
        table = AdamTable({k: getattr(gaussian_map, k) for k in KEYS})
        return Gaussians(table, gaussian_map.anchor_frame_ids, trust)

    @property
    def map(self) -> GaussianMap:
        """The values alone; shares their memory."""
        return GaussianMap(**{k: v.detach() for k, v in self.table.values.items()}, anchor_frame_ids=self.anchors)

    def __len__(self) -> int:
        return len(self.anchors)

    def append(self, seeds: GaussianMap, trust: Tensor) -> None:
        """Add Gaussians with empty moments."""
        self.table.append({k: getattr(seeds, k) for k in KEYS})
        self.anchors, self.trust = torch.cat([self.anchors, seeds.anchor_frame_ids]), torch.cat([self.trust, trust])

    def keep(self, rows: Tensor) -> None:
        """Keep the rows (M,) bool alone."""
        self.table.keep(rows)
        self.anchors, self.trust = self.anchors[rows], self.trust[rows]

    @torch.no_grad()
    def resize(self, log_scale: float) -> None:
        """Scale the map about the world's origin."""
        self.table.values["means"].detach().mul_(math.exp(log_scale))
        self.table.values["log_radii"].detach().add_(log_scale)

    def in_view(self, pose: Tensor, intrinsics: Intrinsics) -> Tensor:
        """Rows (n,) of the Gaussians that a camera sees."""
        radii = torch.exp(self.table.values["log_radii"].detach())
        return in_view(self.table.values["means"].detach(), radii, pose, intrinsics)

    def leaves(self, rows: Tensor) -> dict[str, Tensor]:
        """Copies of the rows (n,) that gradients can be asked for."""
        return {k: v.detach()[rows].requires_grad_() for k, v in self.table.values.items()}

    def to_tensors(self) -> dict[str, Tensor]:
        """A flat table for a snapshot; `from_tensors` is the inverse."""
        return {**self.table.to_tensors("map"), "anchors": self.anchors, "map_trust": self.trust}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> Gaussians:
        """Restore what `to_tensors` returned."""
        return Gaussians(AdamTable.from_tensors(tensors, "map", KEYS), tensors["anchors"], tensors["map_trust"])


def show(
    values: Mapping[str, Tensor], pose: Tensor, view: View, twist: Tensor | None = None, kappa: float = 0.0
) -> Rendering:
    """Draw Eqs. (6) to (9): features (H, W, 3 + K) are colours beside semantic vectors, differentiable in all."""
    features = torch.cat([values["colors"], values["class_logits"] / SEED_LOGIT], 1)
    radii, opacities = torch.exp(values["log_radii"]), torch.sigmoid(values["opacity_logits"])
    return draw_semantics(values["means"], radii, opacities, features, pose, view.intrinsics, twist, view.depth, kappa)


def semantic_image(view: View, classes: int) -> Tensor:
    """S_gt (H, W, K): 1 for a pixel's class, 0 for the others; all 0 for void."""
    channels = view.channels.long()
    one_hot = torch.nn.functional.one_hot(channels.clamp(max=classes), classes + 1)[..., :classes].float()
    return one_hot * (channels != VOID)[..., None]


def scaled_depth(view: View, scale: Tensor) -> View:
    """The view with its proxy depth times scale, (H, W) or one number."""
    return replace(view, depth=(view.depth * scale).float())
