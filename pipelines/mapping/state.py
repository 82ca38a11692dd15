"""State of the optimisation, as a snapshot holds it: the map's parameters, poses and exposures of the views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...formats.tensors import load_tensors, save_tensors
from ..geometry import se3
from ..render.api import moved, require_all_finite
from ..render.gaussian_map import GaussianMap
from ..system.adam import AdamTable
from .views import View

KEYS = ("means", "log_radii", "opacity_logits", "colors")
"""What is optimised."""
_KEPT = ("class_logits", "anchor_frame_ids", "trust", "noted")

VIEW_KEYS = ("twist",)

Exposures = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Log gains and offsets, (N, 3) each."""


@dataclass(frozen=True)
class OptimisedMap:
    """The map, and per view the refined cam_from_world (N, 4, 4), log_gains (N, 3) and offsets (N, 3)."""

    gaussian_map: GaussianMap
    cam_from_world: NDArray[np.float64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]
    iterations: int


@dataclass(frozen=True)
class PoseStep:
    """A view's pose before it was refined, and the gradient by which its twist is to move; None for not at all. `rate`:
    of Adam, in radians, and in shares of the `unit` of length."""

    cam_from_world: Tensor
    gradient: Tensor | None
    rate: float
    unit: float


@dataclass
class OptimiserState:
    """The map's parameters, each view's twist, the exposures (N, 2, 3) of all views, and the number of steps done.

    Twists and poses stay on the host, wherever the map is: six numbers at a time are no work for a GPU. Gradients
    found on a card wait there until somebody asks for a pose of theirs: all views' come in one copy, where one a visit
    would make the host wait for each.
    """

    parameters: MapParameters
    view_tables: list[AdamTable]
    exposures: Tensor
    iteration: int = 0
    _waiting: dict[int, PoseStep] = field(default_factory=dict)

    @staticmethod
    def fresh(
        views: Sequence[View], classes: int, initial: GaussianMap | None, exposure: Exposures | None
    ) -> OptimiserState:
        """No step done: the given map or an empty one, the views where they are."""
        device = views[0].image.device
        exposures = torch.zeros(len(views), 2, 3, device=device)
        if exposure is not None:
            exposures = torch.as_tensor(np.stack(exposure, axis=1), dtype=torch.float32, device=device)
        tables = [AdamTable({"twist": torch.zeros(6)}) for _ in views]
        return OptimiserState(MapParameters.from_map(initial or empty_map(classes, device)), tables, exposures)

    @staticmethod
    def load(snapshot: Path | None, views: Sequence[View]) -> OptimiserState | None:
        """Load what `save` wrote; None where there is no such file."""
        if snapshot is None or not snapshot.exists():
            return None
        loaded = load_tensors(snapshot)
        tables = [AdamTable.from_tensors(loaded, f"view{i}", VIEW_KEYS) for i in range(len(views))]
        tensors = {k: v.to(views[0].image.device) for k, v in loaded.items() if not k.startswith("view")}
        parameters, iteration = MapParameters.from_tensors(tensors), int(tensors["iteration"])
        return OptimiserState(parameters, tables, tensors["exposures"], iteration)

    def save(self, snapshot: Path) -> None:
        """Into one file, whole or not at all."""
        self.settle_poses()
        out = {**self.parameters.to_tensors(), "exposures": self.exposures, "iteration": torch.tensor(self.iteration)}
        for i, table in enumerate(self.view_tables):
            out |= table.to_tensors(f"view{i}")
        save_tensors(snapshot, out)

    def cam_from_world(self, index: int, view: View) -> Tensor:
        """(4, 4) float64 on the host: the view's pose as it is refined by now."""
        if index in self._waiting:
            self.settle_poses()
        return se3.exp(self.view_tables[index].values["twist"].detach().double()) @ view.cam_from_world

    def step_pose(self, index: int, view: View, gradient: Tensor | None, rate: float, unit: float) -> None:
        """One step of Adam for the view's twist by the gradient of its pose (4, 4), wherever that lies. `rate`: of the
        rotation in radians, of the translation in shares of `unit`, a length of the scene."""
        self._waiting[index] = PoseStep(view.cam_from_world, gradient, rate, unit)
        if gradient is None or gradient.device.type == "cpu":
            self.settle_poses()

    def settle_poses(self) -> None:
        """Take the steps that wait, of which a card brings the gradients in one copy."""
        steps, self._waiting = self._waiting, {}
        given = [s.gradient for s in steps.values() if s.gradient is not None]
        found = iter(torch.stack(given).cpu() if given else ())
        for index, step in steps.items():
            table = self.view_tables[index]
            twist = table.values["twist"]
            gradients: dict[str, Tensor | None] = {}
            if step.gradient is not None:
                with torch.enable_grad():
                    pose = moved(step.cam_from_world, twist)
                gradients["twist"] = torch.autograd.grad(pose, twist, next(found).to(pose))[0]
            table.step(gradients, {"twist": step.rate}, {"twist": torch.tensor([step.unit] * 3 + [1.0] * 3)})

    def result(self, views: Sequence[View], iterations: int) -> OptimisedMap:
        """The values without the optimiser's own."""
        poses = [self.cam_from_world(i, v) for i, v in enumerate(views)]
        gains, offsets = self.exposures.cpu().unbind(1)
        return OptimisedMap(
            self.parameters.to_map(), torch.stack(poses).numpy(), gains.numpy(), offsets.numpy(), iterations
        )


@dataclass
class MapParameters:
    """A Gaussian map being optimised; beside it `class_logits` (M, C), `anchor_frame_ids` (M,), `trust` (M,) 0..1 of
    the depth it was seeded at, and `noted` (M, 2) of this pass so far: the largest blending weight in any pixel, and
    the colour error that a Gaussian answers for in the view where that is most."""

    table: AdamTable
    class_logits: Tensor
    anchor_frame_ids: Tensor
    trust: Tensor
    noted: Tensor

    @staticmethod
    def from_map(gaussian_map: GaussianMap) -> MapParameters:
        """Fresh moments, full trust."""
        values = {k: getattr(gaussian_map, k) for k in KEYS}
        m = gaussian_map
        others = (m.class_logits, m.anchor_frame_ids, torch.ones_like(m.log_radii), m.log_radii.new_zeros(len(m), 2))
        return MapParameters(AdamTable(values), *others)

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
        self.noted = self.noted[rows]

    def append(self, seeds: GaussianMap, trust: Tensor, weight: float = 0.0) -> None:
        """Add Gaussians with empty moments, their weight noted as given: what is added within a pass that notes weights
        was not there for its first visits, and would be pruned for it."""
        self.table.append({k: getattr(seeds, k) for k in KEYS})
        self.class_logits = torch.cat([self.class_logits, seeds.class_logits])
        self.anchor_frame_ids = torch.cat([self.anchor_frame_ids, seeds.anchor_frame_ids])
        self.trust = torch.cat([self.trust, trust])
        added = torch.stack([torch.full_like(trust, weight), torch.zeros_like(trust)], 1)
        self.noted = torch.cat([self.noted, added])

    def to_tensors(self) -> dict[str, Tensor]:
        """A flat table for a snapshot."""
        others = {name: getattr(self, name) for name in _KEPT}
        return {**self.table.to_tensors("map"), **others}

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor]) -> MapParameters:
        """Restore the parameters from what `to_tensors` returned."""
        table = AdamTable.from_tensors(tensors, "map", KEYS)
        return MapParameters(table, *(tensors[name] for name in _KEPT))


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
