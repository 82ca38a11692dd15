"""Optimising the map against its views: seed along the keyframes, then visit all of them in random order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.tensors import load_tensors, save_tensors
from pipelines.config import MappingConfig
from pipelines.gaussians import densify, losses
from pipelines.gaussians.map import GaussianMap
from pipelines.gaussians.parameters import AdamTable, MapParameters, empty_map
from pipelines.gaussians.render import Rendering, render
from pipelines.gaussians.schedule import Schedule, Seeding, Step
from pipelines.gaussians.seeding import SEED_OPACITY, SeedDepth, complete_depth, seed_gaussians, seed_grid
from pipelines.geometry import se3
from pipelines.mapping.views import View, halved
from pipelines.progress import Progress, SilentProgress

VIEW_KEYS = ("twist", "log_gain", "offset")
GROWN_OPACITY, ERROR_OPACITY = 0.3, 0.1
"""Of Gaussians added to a map that is already there: opaque ones would hide what has been learnt."""
_LOW_RELIABILITY = 0.35
_HIGH_RELIABILITY = 0.85
_SOLID = 0.8
"""Silhouette above which the map knows the depth of a pixel."""


@dataclass(frozen=True)
class OptimisedMap:
    """The map, and per view the refined cam_from_world (N, 4, 4), log_gains (N, 3) and offsets (N, 3)."""

    gaussian_map: GaussianMap
    cam_from_world: NDArray[np.float64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]
    iterations: int


def optimise_map(
    views: Sequence[View],
    classes: int,
    settings: MappingConfig,
    seed: int,
    initial: GaussianMap | None = None,
    passes: float | None = None,
    progress: Progress | None = None,
    snapshot: Path | None = None,
    label: str = "mapping",
    exposure: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
) -> OptimisedMap:
    """The map that explains the views (MSGS-SLAM eqs. 17-20), with their poses and exposures refined together.

    Without `initial` the map is seeded along the views; with it the views are only visited, `passes` times each. With
    `snapshot`, a file, the work goes on from there when it exists, and ends with the same bytes. `exposure`: log gains
    and offsets (N, 3) to start from.
    """
    state = _load_state(snapshot, views) or _fresh_state(views, classes, initial, exposure)
    schedule = Schedule.plan(views, settings, seed, seeding=initial is None, passes=passes)
    optimiser = MapOptimiser(views, classes, settings, state)
    remaining = range(state.iteration, schedule.total)
    for iteration in (progress or SilentProgress()).track(remaining, label, len(remaining)):
        optimiser.visit(schedule.step(iteration))
        state.iteration = iteration + 1
        if snapshot is not None and state.iteration % settings.snapshot_every == 0:
            save_tensors(snapshot, state.to_tensors())
    optimiser.prune()
    return state.result(views, schedule.total)


@dataclass
class OptimiserState:
    """Everything that changes: what a snapshot holds."""

    parameters: MapParameters
    view_tables: list[AdamTable]
    iteration: int = 0

    def to_tensors(self) -> dict[str, Tensor]:
        """A flat table; `from_tensors` is the inverse."""
        out = {**self.parameters.to_tensors(), "iteration": torch.tensor(self.iteration)}
        for i, table in enumerate(self.view_tables):
            out |= table.to_tensors(f"view{i}")
        return out

    @staticmethod
    def from_tensors(tensors: dict[str, Tensor], count: int, device: torch.device) -> OptimiserState:
        """Inverse of `to_tensors`."""
        moved = {k: v.to(device) for k, v in tensors.items()}
        tables = [AdamTable.from_tensors(moved, f"view{i}", VIEW_KEYS) for i in range(count)]
        return OptimiserState(MapParameters.from_tensors(moved), tables, int(tensors["iteration"]))

    def result(self, views: Sequence[View], iterations: int) -> OptimisedMap:
        """The values without the optimiser's own."""
        values = {k: [t.values[k].detach().cpu() for t in self.view_tables] for k in VIEW_KEYS}
        poses = [se3.exp(t.double()) @ v.cam_from_world.cpu() for t, v in zip(values["twist"], views, strict=True)]
        gains, offsets = (torch.stack(values[k]).numpy() for k in ("log_gain", "offset"))
        return OptimisedMap(self.parameters.to_map(), torch.stack(poses).numpy(), gains, offsets, iterations)


def _load_state(snapshot: Path | None, views: Sequence[View]) -> OptimiserState | None:
    if snapshot is None or not snapshot.exists():
        return None
    return OptimiserState.from_tensors(load_tensors(snapshot), len(views), views[0].image.device)


def _fresh_state(
    views: Sequence[View],
    classes: int,
    initial: GaussianMap | None,
    exposure: tuple[NDArray[np.float32], NDArray[np.float32]] | None,
) -> OptimiserState:
    device = views[0].image.device
    gains, offsets = exposure or (np.zeros((len(views), 3), np.float32), np.zeros((len(views), 3), np.float32))
    tables = [
        AdamTable(
            {
                "twist": torch.zeros(6, device=device),
                "log_gain": torch.as_tensor(g, dtype=torch.float32, device=device),
                "offset": torch.as_tensor(o, dtype=torch.float32, device=device),
            }
        )
        for g, o in zip(gains, offsets, strict=True)
    ]
    return OptimiserState(MapParameters.from_map(initial or empty_map(classes, device)), tables)


@dataclass
class MapOptimiser:
    """One visit at a time: draw a view, compare, step; and now and then grow and prune."""

    views: Sequence[View]
    classes: int
    settings: MappingConfig
    state: OptimiserState
    halves: list[View] = field(init=False)
    unit: float = field(init=False)

    def __post_init__(self) -> None:
        self.halves = [halved(v) for v in self.views]
        self.unit = scene_depth(self.views)

    def visit(self, step: Step) -> None:
        """Do what the schedule says: seed, compare, grow, prune."""
        view = (self.halves if step.coarse else self.views)[step.view]
        if step.seed is not Seeding.NOTHING:
            self.seed(step.view, step.seed)
        if len(self.state.parameters) == 0:
            return
        table = self.state.view_tables[step.view]
        with_labels = self._uses_labels(step.iteration) or step.grow
        rendering = self.draw(view, table, with_labels)
        loss = self._loss(view, table, rendering, with_labels) * step.weight
        loss.backward()
        self.state.parameters.table.step(self._map_rates(step.rate))
        table.step(self._view_rates(step))
        if step.grow:
            self.grow(step.view, Rendering(*(x.detach() for x in vars(rendering).values())))
        if step.prune:
            self.prune()

    def draw(self, view: View, table: AdamTable, with_classes: bool = True) -> Rendering:
        """The map as the view's camera sees it now."""
        parameters, settings = self.state.parameters, self.settings
        return render(
            parameters["means"],
            torch.exp(parameters["log_radii"]),
            torch.sigmoid(parameters["opacity_logits"]),
            parameters.features(with_classes),
            view.cam_from_world,
            view.intrinsics,
            proxy_depth=view.depth if settings.kappa > 0 else None,
            kappa=settings.kappa / self.unit**2,
            twist=table.values["twist"] if settings.refine_poses else None,
        )

    def _uses_labels(self, iteration: int) -> bool:
        return self.classes > 0 and self.settings.label_weight > 0 and iteration % self.settings.label_every == 0

    def _loss(self, view: View, table: AdamTable, rendering: Rendering, with_labels: bool) -> Tensor:
        """MSGS-SLAM eq. (18)."""
        s = self.settings
        colors = expose(rendering.features[..., :3], table)
        loss = s.color_weight * losses.image_loss(colors, view.colors, s.ssim_weight)
        loss = loss + s.silhouette_weight * losses.silhouette_loss(rendering.silhouette)
        loss = loss + s.size_weight * losses.size_loss(self.state.parameters["log_radii"], s.size_limit * self.unit)
        if s.depth_weight > 0 and s.use_proxy_depth:
            weight = losses.depth_weight(view.trust, s.depth_nu)
            loss = loss + s.depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        if s.edge_weight > 0 and with_labels and self.classes > 0:
            edge = losses.edge_loss(rendering.depth, view.channels, s.edge_sharpness, self.unit)
            loss = loss + s.edge_weight * s.label_every * edge
        if with_labels and s.label_weight > 0 and self.classes > 0:
            loss = loss + s.label_weight * s.label_every * self._label_loss(view, rendering.features[..., 3:])
        # Exposures are relative: without a pull to zero they and the colours drift together.
        values = table.values
        return loss + 0.1 * (values["log_gain"].square().sum() + values["offset"].square().sum())

    def _label_loss(self, view: View, logits: Tensor) -> Tensor:
        if self.settings.label_loss == "image":
            return losses.label_image_loss(logits, view.channels, view.label_weight, self.settings.ssim_weight)
        return losses.label_loss(logits, view.channels, view.label_weight)

    def _map_rates(self, factor: float) -> dict[str, float]:
        s = self.settings
        rates = {
            "means": s.mean_rate * self.unit,
            "log_radii": s.radius_rate,
            "opacity_logits": s.opacity_rate,
            "colors": s.color_rate,
            "class_logits": s.class_rate,
        }
        return {k: v * factor for k, v in rates.items()}

    def _view_rates(self, step: Step) -> dict[str, float]:
        s = self.settings
        poses = s.refine_poses and step.refine_pose
        return {
            "twist": s.pose_rate * step.rate if poses else 0.0,
            "log_gain": s.exposure_rate * step.rate if s.exposure else 0.0,
            "offset": s.exposure_rate * step.rate if s.exposure else 0.0,
        }

    @torch.no_grad()
    def seed(self, index: int, what: Seeding) -> None:
        """Fill the view's holes with Gaussians at its completed depth (eq. 17): the trusted ones, or the rest."""
        view, s = self.views[index], self.settings
        pixels = self._grid(view)
        if len(self.state.parameters) == 0:
            completed = self._completed(index)
        else:
            rendering = self.draw(view, self.state.view_tables[index], with_classes=False)
            pixels &= self._needed(view, rendering) if what is Seeding.TRUSTED else self._holes(rendering)
            completed = self._completed(index) if what is Seeding.TRUSTED else self._completed_by_map(view, rendering)
        depth, trust = (torch.from_numpy(x).to(view.image.device) for x in (completed.depth, completed.trust))
        if what is Seeding.TRUSTED:
            pixels &= trust > _LOW_RELIABILITY
        self._append(index, pixels, depth, trust, s.seed_stride, SEED_OPACITY)

    def _grid(self, view: View) -> Tensor:
        height, width = view.depth.shape
        return torch.from_numpy(seed_grid(height, width, self.settings.seed_stride)).to(view.image.device)

    def _holes(self, rendering: Rendering) -> Tensor:
        """Condition (a)."""
        return densify.holes(rendering.silhouette, self.settings.silhouette_threshold)

    @torch.no_grad()
    def grow(self, index: int, rendering: Rendering) -> None:
        """Add Gaussians by the three conditions of the article, and where the colours are most wrong."""
        view, s = self.views[index], self.settings
        needed = self._needed(view, rendering)
        needed |= densify.wrong_classes(rendering.features[..., 3:], view.channels, view.label_weight)
        grid = self._grid(view)
        colors = expose(rendering.features[..., :3], self.state.view_tables[index])
        wrong = densify.color_errors(colors, view.colors, 1 - s.error_share) & ~grid
        depth, trust = self._grown_depth(view, rendering)
        self._append(index, needed & grid, depth, trust, s.seed_stride, GROWN_OPACITY)
        self._append(index, wrong, depth, trust, 1.0, ERROR_OPACITY)

    def _needed(self, view: View, rendering: Rendering) -> Tensor:
        """Conditions (a) and (b)."""
        needed = self._holes(rendering)
        if self.settings.use_proxy_depth:
            tolerance = self.settings.depth_tolerance
            needed = needed | densify.hidden_surfaces(rendering.depth, view.depth, view.trust, tolerance)
        return needed

    def _grown_depth(self, view: View, rendering: Rendering) -> tuple[Tensor, Tensor]:
        """(H, W) depth and trust: the proxy where it is reliable, else the map's own; 0 where neither knows."""
        # A trusted proxy is sharp at depth edges, where the map's blended depth lies between the surfaces.
        nearer = densify.hidden_surfaces(rendering.depth, view.depth, view.trust, self.settings.depth_tolerance)
        use_map = (rendering.silhouette > _SOLID) & ~nearer & (view.trust < _HIGH_RELIABILITY)
        proxy = torch.where(view.trust > _LOW_RELIABILITY, view.depth, 0.0)
        return torch.where(use_map, rendering.depth, proxy), torch.where(use_map, _LOW_RELIABILITY, view.trust)

    def _completed(self, index: int) -> SeedDepth:
        view = self.views[index]
        return self._complete(view, view.depth, view.trust)

    def _completed_by_map(self, view: View, rendering: Rendering) -> SeedDepth:
        """The view's depth, completed from what the other views have put into the map around its holes."""
        known = (rendering.silhouette > _SOLID) & (view.trust < _HIGH_RELIABILITY)
        trust = torch.where(known, view.trust.clamp(min=2 * _LOW_RELIABILITY), view.trust)
        return self._complete(view, torch.where(known, rendering.depth, view.depth), trust)

    def _complete(self, view: View, depth: Tensor, trust: Tensor) -> SeedDepth:
        channels, prior = view.channels.cpu().numpy(), self.settings.region_prior
        return complete_depth(depth.cpu().numpy(), trust.cpu().numpy(), channels, _LOW_RELIABILITY, prior)

    def _append(self, index: int, pixels: Tensor, depth: Tensor, trust: Tensor, spacing: float, opacity: float) -> None:
        parameters, view = self.state.parameters, self.views[index]
        pixels = pixels & (depth > 0)
        if not pixels.any() or len(parameters) >= self.settings.max_gaussians:
            return
        pose = se3.exp(self.state.view_tables[index].values["twist"].detach().double()) @ view.cam_from_world
        seeds = seed_gaussians(
            pixels, depth, view.colors, view.channels, spacing, self.classes, pose, view.intrinsics, view.frame_id
        )
        seeds.opacity_logits.fill_(math.log(opacity / (1 - opacity)))
        parameters.append(seeds, trust[pixels])

    @torch.no_grad()
    def prune(self) -> None:
        """Drop the Gaussians nobody sees."""
        parameters, s = self.state.parameters, self.settings
        bad = densify.useless(parameters.to_map(), s.prune_opacity, s.prune_radius * self.unit)
        if bad.any():
            parameters.keep(~bad)


def expose(colors: Tensor, table: AdamTable) -> Tensor:
    """(H, W, 3) colours of the map as this view's exposure shows them."""
    return colors * torch.exp(table.values["log_gain"]) + table.values["offset"]


def scene_depth(views: Sequence[View]) -> float:
    """Median proxy depth of the views, the unit of everything that must not depend on the unit of the world."""
    samples = [v.depth[::8, ::8][v.depth[::8, ::8] > 0] for v in views]
    together = torch.cat(samples)
    return float(together.median()) if len(together) else 1.0
