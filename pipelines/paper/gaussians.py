"""The map as the paper optimises it: G_i = (μ_i, r_i, σ_i, c_i, s_i), with the keyframe that each was seeded from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..compute.adam import AdamTable
from ..mapping.seeding import SEED_LOGIT
from ..mapping.views import View
from ..render.api import Rendering, in_view
from ..render.gaussian_map import GaussianMap
from ..types import VOID, Intrinsics
from .rendering import draw

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
    return draw(values["means"], radii, opacities, features, pose, view.intrinsics, twist, view.depth, kappa)


def semantic_image(view: View, classes: int) -> Tensor:
    """S_gt (H, W, K): 1 for a pixel's class, 0 for the others; all 0 for void."""
    channels = view.channels.long()
    one_hot = torch.nn.functional.one_hot(channels.clamp(max=classes), classes + 1)[..., :classes].float()
    return one_hot * (channels != VOID)[..., None]


def scaled_depth(view: View, scale: Tensor) -> View:
    """The view with its proxy depth times scale, (H, W) or one number."""
    return replace(view, depth=(view.depth * scale).float())
