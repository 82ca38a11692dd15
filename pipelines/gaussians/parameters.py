"""The map while it is optimised: raw parameters and Adam's moments under the same keys, kept aligned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.optim.adam import adam

from pipelines.gaussians.map import GaussianMap

KEYS = ("means", "log_radii", "opacity_logits", "colors", "class_logits")


@dataclass
class AdamTable:
    """Named parameters with Adam's first and second moments (Kingma and Ba 2015) and one common step count."""

    values: dict[str, Tensor]
    first: dict[str, Tensor] = field(default_factory=dict)
    second: dict[str, Tensor] = field(default_factory=dict)
    steps: int = 0

    def __post_init__(self) -> None:
        for key, value in self.values.items():
            self.values[key] = value.detach().clone().contiguous().requires_grad_()
            self.first.setdefault(key, torch.zeros_like(value))
            self.second.setdefault(key, torch.zeros_like(value))

    def step(self, rates: Mapping[str, float], shares: Tensor | None = None) -> None:
        """One Adam step for the parameters that have a gradient; consumes the gradients.

        `shares` (M,): how much of the step each row takes, None for all of it.
        """
        self.steps += 1
        for key, value in self.values.items():
            if value.grad is None or rates.get(key, 0.0) == 0.0:
                value.grad = None
                continue
            # adam() counts the step itself, hence one less.
            count = torch.tensor(float(self.steps - 1), device=value.device)
            before = value.detach().clone() if shares is not None else None
            with torch.no_grad():
                adam(
                    [value], [value.grad], [self.first[key]], [self.second[key]], [], [count], fused=True,
                    amsgrad=False, beta1=0.9, beta2=0.999, lr=rates[key], weight_decay=0.0, eps=1e-15, maximize=False,
                )  # fmt: skip
                if before is not None and shares is not None:
                    torch.lerp(before, value, shares.reshape(-1, *[1] * (value.ndim - 1)), out=value)
            value.grad = None

    def keep(self, rows: Tensor) -> None:
        """Keep only the given rows: (M,) bool or indices."""
        for table in (self.first, self.second):
            for key in table:
                table[key] = table[key][rows].contiguous()
        for key, value in self.values.items():
            self.values[key] = value.detach()[rows].contiguous().requires_grad_()

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows with empty moments."""
        for key, value in self.values.items():
            self.values[key] = torch.cat([value.detach(), rows[key]]).contiguous().requires_grad_()
            for table in (self.first, self.second):
                table[key] = torch.cat([table[key], torch.zeros_like(rows[key])]).contiguous()

    def to_tensors(self, prefix: str) -> dict[str, Tensor]:
        """A flat table for a snapshot; `from_tensors` is the inverse."""
        out = {f"{prefix}.steps": torch.tensor(self.steps)}
        for key, value in self.values.items():
            out[f"{prefix}.{key}"] = value.detach()
            out[f"{prefix}.first.{key}"] = self.first[key]
            out[f"{prefix}.second.{key}"] = self.second[key]
        return out

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], prefix: str, keys: tuple[str, ...]) -> AdamTable:
        """Inverse of `to_tensors`."""
        return AdamTable(
            {k: tensors[f"{prefix}.{k}"] for k in keys},
            {k: tensors[f"{prefix}.first.{k}"] for k in keys},
            {k: tensors[f"{prefix}.second.{k}"] for k in keys},
            int(tensors[f"{prefix}.steps"]),
        )


@dataclass
class MapParameters:
    """A Gaussian map being optimised; `anchor_frame_ids` (M,) and `trust` (M,) 0..1 of the depth it was seeded at."""

    table: AdamTable
    anchor_frame_ids: Tensor
    trust: Tensor

    @staticmethod
    def from_map(gaussian_map: GaussianMap) -> MapParameters:
        """Fresh moments, full trust."""
        values = {k: getattr(gaussian_map, k) for k in KEYS}
        return MapParameters(AdamTable(values), gaussian_map.anchor_frame_ids, torch.ones_like(gaussian_map.log_radii))

    def to_map(self) -> GaussianMap:
        """The map as it stands."""
        return GaussianMap(**{k: self[k].detach().clone() for k in KEYS}, anchor_frame_ids=self.anchor_frame_ids)

    def __getitem__(self, key: str) -> Tensor:
        return self.table.values[key]

    def __len__(self) -> int:
        return len(self.anchor_frame_ids)

    def features(self, with_classes: bool = True) -> Tensor:
        """(M, 3 + C) colours and class logits, or (M, 3) colours alone."""
        return torch.cat([self["colors"], self["class_logits"]], dim=1) if with_classes else self["colors"]

    def keep(self, rows: Tensor) -> None:
        """Keep only the given rows everywhere."""
        self.table.keep(rows)
        self.anchor_frame_ids, self.trust = self.anchor_frame_ids[rows], self.trust[rows]

    def append(self, seeds: GaussianMap, trust: Tensor) -> None:
        """Add Gaussians with empty moments."""
        self.table.append({k: getattr(seeds, k) for k in KEYS})
        self.anchor_frame_ids = torch.cat([self.anchor_frame_ids, seeds.anchor_frame_ids])
        self.trust = torch.cat([self.trust, trust])

    def to_tensors(self) -> dict[str, Tensor]:
        """A flat table for a snapshot."""
        return {**self.table.to_tensors("map"), "anchor_frame_ids": self.anchor_frame_ids, "trust": self.trust}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> MapParameters:
        """Inverse of `to_tensors`."""
        table = AdamTable.from_tensors(tensors, "map", KEYS)
        return MapParameters(table, tensors["anchor_frame_ids"], tensors["trust"])


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
