"""The semantic map: isotropic 3D Gaussians with colour and class logits (method eq. 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.se3 import Similarity

DECIDED_LOGIT = 1.0
"""A third of what a seed gives its class. Measured on true labels with void: 85 % of the void stays void, and of the
labelled pixels none is lost."""
_AT_ONCE = 1 << 18
"""Gaussians of which there are copies in double precision."""


@dataclass(frozen=True)
class GaussianMap:
    """M isotropic Gaussians, raw parameters as they are optimised.

    means (M, 3), log_radii (M,), opacity_logits (M,), colors (M, 3) RGB 0..1, class_logits (M, C), all float32;
    anchor_frame_ids (M,) int64: the keyframe each Gaussian was seeded from and moves with.
    """

    means: Tensor
    log_radii: Tensor
    opacity_logits: Tensor
    colors: Tensor
    class_logits: Tensor
    anchor_frame_ids: Tensor

    def __post_init__(self) -> None:
        m = self.means.shape[0]
        shapes = {"means": (m, 3), "log_radii": (m,), "opacity_logits": (m,), "colors": (m, 3)}
        shapes |= {"class_logits": (m, self.class_logits.shape[-1]), "anchor_frame_ids": (m,)}
        for name, expected in shapes.items():
            if (got := tuple(getattr(self, name).shape)) != expected:
                raise ValueError(f"{name}: got shape {got}, expected {expected}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def radii(self) -> Tensor:
        """(M,) standard deviations, in the unit of the world."""
        return torch.exp(self.log_radii)

    @property
    def opacities(self) -> Tensor:
        """Opacities (M,) in 0..1."""
        return torch.sigmoid(self.opacity_logits)

    def only(self, rows: Tensor | slice) -> GaussianMap:
        """The Gaussians of rows (M,) bool, indices or a slice."""
        if isinstance(rows, Tensor) and rows.dtype == torch.int64:  # a third of the time of brackets
            there = rows.to(self.means.device)
            return GaussianMap(**{name: tensor.index_select(0, there) for name, tensor in vars(self).items()})
        return GaussianMap(**{name: tensor[rows] for name, tensor in vars(self).items()})

    def to(self, device: str) -> GaussianMap:
        """Copy the map to a device, where it is not there already."""
        return GaussianMap(**{name: tensor.to(device) for name, tensor in vars(self).items()})

    def moved(self, other_from_world: Similarity) -> GaussianMap:
        """Transform the map into another world; radii grow with the scale."""
        parts = self.means.detach().cpu().split(_AT_ONCE)
        means = [torch.from_numpy(other_from_world.apply(p.numpy().astype("float64"))).to(p.dtype) for p in parts]
        return replace(
            self,
            means=torch.cat(means).to(self.means.device),
            log_radii=self.log_radii + math.log(other_from_world.scale),
        )


def decided_channels(logits: Tensor) -> Tensor:
    """(..., C) class logits → (...) int64 channels; -1 where no class dominates: what was void in every view.

    Seeds of void pixels have logits of zero, and what no label has spoken for stays near that.
    """
    if logits.shape[-1] == 0:
        return torch.full(logits.shape[:-1], -1, dtype=torch.int64, device=logits.device)
    strength, channel = logits.max(-1)
    return torch.where(strength > DECIDED_LOGIT, channel, -1)
