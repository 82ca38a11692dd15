"""The map while it is optimised: raw parameters and Adam's moments under the same keys, kept aligned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussian_map import GaussianMap
from ..gaussians.adam import AdamTable
from ..gaussians.render.compositing import require_all_finite

KEYS = ("means", "log_radii", "opacity_logits", "colors")
"""What is optimised."""
_BESIDE = ("class_logits", "anchor_frame_ids", "trust")


@dataclass
class MapParameters:
    """A Gaussian map being optimised; beside it `class_logits` (M, C), `anchor_frame_ids` (M,) and `trust` (M,) 0..1 of
    the depth it was seeded at."""

    table: AdamTable
    class_logits: Tensor
    anchor_frame_ids: Tensor
    trust: Tensor

    @staticmethod
    def from_map(gaussian_map: GaussianMap) -> MapParameters:
        """Fresh moments, full trust."""
        values = {k: getattr(gaussian_map, k) for k in KEYS}
        m = gaussian_map
        return MapParameters(AdamTable(values), m.class_logits, m.anchor_frame_ids, torch.ones_like(m.log_radii))

    def to_map(self) -> GaussianMap:
        """Return a copy of the current map."""
        values = {k: self[k].detach().clone() for k in KEYS}
        return GaussianMap(**values, class_logits=self.class_logits, anchor_frame_ids=self.anchor_frame_ids)

    def __getitem__(self, key: str) -> Tensor:
        return self.table.values[key]

    def __len__(self) -> int:
        return len(self.anchor_frame_ids)

    def require_finite_on_card(self) -> None:
        """Raise ValueError for NaN or infinity on a card, where the renderer does not look for them as on the CPU."""
        if self.trust.device.type != "cpu":
            require_all_finite(self.table.values)

    def keep(self, rows: Tensor) -> None:
        """Keep only the given rows everywhere."""
        self.table.keep(rows)
        self.class_logits = self.class_logits[rows]
        self.anchor_frame_ids, self.trust = self.anchor_frame_ids[rows], self.trust[rows]

    def append(self, seeds: GaussianMap, trust: Tensor) -> None:
        """Add Gaussians with empty moments."""
        self.table.append({k: getattr(seeds, k) for k in KEYS})
        self.class_logits = torch.cat([self.class_logits, seeds.class_logits])
        self.anchor_frame_ids = torch.cat([self.anchor_frame_ids, seeds.anchor_frame_ids])
        self.trust = torch.cat([self.trust, trust])

    def to_tensors(self) -> dict[str, Tensor]:
        """A flat table for a snapshot."""
        beside = {name: getattr(self, name) for name in _BESIDE}
        return {**self.table.to_tensors("map"), **beside}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> MapParameters:
        """Restore the parameters from what `to_tensors` returned."""
        table = AdamTable.from_tensors(tensors, "map", KEYS)
        return MapParameters(table, *(tensors[name] for name in _BESIDE))


def empty_map(classes: int, device: torch.device | str = "cpu") -> GaussianMap:
    """A map of no Gaussians with `classes` class channels."""
    return GaussianMap(
        means=torch.zeros(0, 3, device=device),
        log_radii=torch.zeros(0, device=device),
        opacity_logits=torch.zeros(0, device=device),
        colors=torch.zeros(0, 3, device=device),
        class_logits=torch.zeros(0, classes, device=device),
        anchor_frame_ids=torch.zeros(0, dtype=torch.int64, device=device),
    )
