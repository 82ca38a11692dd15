"""Optimising the map against its views: seed along the keyframes, then visit all of them in random order. Which view is
visited when is a pure function of the iteration, so that a resumed run goes on as an unbroken one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from ..config import MappingConfig
from ..geometry.posed_depth import overlaps
from ..render.api import Rendering, blending_weights, class_weights, in_view, marked_in_view, project_map, render
from ..render.gaussian_map import GaussianMap
from ..render.rules import GaussianStats
from ..system import gpu
from ..system.adam import gradients_of
from ..system.parallel import LruSequence
from ..system.progress import Progress, SilentProgress, is_asked
from .growth import HIGH_RELIABILITY, LOW_RELIABILITY, SEED_LOGIT, Growth, Seeding
from .losses import SOLID, Objective, expose, fit_exposure
from .state import KEYS, Exposures, OptimisedMap, OptimiserState
from .views import View, half_view

_FLOOR = 1 / (math.exp(SEED_LOGIT) - 1)
"""Added to every share of a class: one that has all votes gets the logit of a seed's own class, one without any 0."""
SNAPSHOT_EVERY = 150
"""Visits between two snapshots, at most."""
_MIN_VOTES = 1e-6
"""Pixels: who has less of all views keeps the classes that he has."""

_HARDLY_SEEN = 0.3
"""Pixels below which a Gaussian hardly counts when the colours are solved."""
MAP_RATES = {"means": 0.1, "log_radii": 3e-2, "opacity_logits": 8e-2, "colors": 2.5e-2}
"""Learning rates of Adam, of positions in radii of the Gaussian: what is small has to be placed finely."""
HALVES_ROOM = 250e6
"""Bytes of views at half the size that are kept; to halve one takes a hundredth of a visit."""
POSE_RATE = 1e-4
"""Learning rate of a view's twist: of rotations in radians, of translations in median depths of the scene."""
LOW_TRUST_STEP = 4.0
"""Steps of Gaussians of unreliable depth are so many times as large, of medium ones by its root."""

WINDOW_STEPS = 2
"""Steps (at half the size) for each keyframe while the map is seeded: on it, covisible and random past ones."""
COARSE_SHARE = 0.25
"""Share of the visits at half the size, before the others."""
DENSIFY_EVERY, DENSIFY_UNTIL = 2, 0.45
"""Passes between two rounds of densification and pruning, and the share of the visits after which there are none."""
RATE_DECAY = 0.03
"""Learning rates at the end, as a share of those at the start. 0.06 shows more on two stretches of eight keyframes, and
0.9 dB less on the whole of replica, where 77 views pull in turn at each Gaussian."""
MIN_SHOWN = 0.5
"""What is left out of the images is made up for by more visits, but by no more than twice as many: a place is visited
as often as if nobody had covered it. A walk of 45 frames with somebody on a fifth of it comes 0.20 dB nearer to
the same walk without her with her outline given, 0.41 dB with that of the networks."""
TIME_DECAY = 0.1
"""τ of eq. (13), a keyframe, while the map is seeded."""
RELIABILITY_DECAY = 1.0
"""δ of eq. (14): keyframes of unreliable depth weigh less."""


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
    exposure: Exposures | None = None,
    first_rate: float = 1.0,
    seeding: bool | None = None,
) -> OptimisedMap:
    """The map that explains the views (MSGS-SLAM eqs. 17-20), with their poses and exposures refined together.

    Without `initial` the map is seeded along the views; with it the views are only visited, `passes` times each, unless
    `seeding`, which fills the holes that it has. With `snapshot`, a file, the work goes on from there when it exists,
    and ends with the same bytes. `exposure`: log gains and offsets (N, 3) to start from; `first_rate`: learning rates
    of the first visit, as a share.
    """
    state = OptimiserState.load(snapshot, views) or OptimiserState.fresh(views, classes, initial, exposure)
    seeding = initial is None if seeding is None else seeding
    schedule = Schedule.plan(views, settings, seed, seeding, passes, first_rate)
    optimiser = MapOptimiser(views, classes, settings, state)
    # A map and its visits grow together: were it written every so many visits, all of it would be written ever longer.
    every = max(min(SNAPSHOT_EVERY, schedule.total // 4), len(views))
    remaining = range(state.iteration, schedule.total)
    for iteration in (progress or SilentProgress()).track(remaining, label, len(remaining)):
        optimiser.step(schedule.step(iteration))
        state.iteration = iteration + 1
        if state.iteration % len(views) == 0:
            state.parameters.require_finite_on_card()
        if snapshot is not None and (state.iteration % every == 0 or is_asked()):
            state.save(snapshot)
    if schedule.grows:
        optimiser.growth.prune(by_weight=False)
    optimiser.solve_colors()
    if classes > 0:
        optimiser.count_labels()
    return state.result(views, schedule.total)


@dataclass(frozen=True)
class Step:
    """One visit: view index, loss weight, learning rate factor, and what happens around it; `note`: what each Gaussian
    weighs and answers for is noted, for the splitting and pruning at the end of the pass."""

    view: int
    weight: float
    rate: float
    coarse: bool
    seed: Seeding = Seeding.NOTHING
    grow: bool = False
    note: bool = False
    split: bool = False
    prune: bool = False
    refine_pose: bool = False


@dataclass(frozen=True)
class Schedule:
    """Seeding steps first, then `visits` over all views, shuffled each pass.

    Seeding goes along the views twice: what is trusted first, for a guess that one view has to make another may know.
    """

    seed: int
    views: int
    seeding: int
    visits: int
    overlap: csr_matrix
    reliability: NDArray[np.float64]
    first_rate: float = 1.0

    @staticmethod
    def plan(
        views: Sequence[View],
        settings: MappingConfig,
        seed: int,
        seeding: bool,
        passes: float | None,
        first_rate: float = 1.0,
    ) -> Schedule:
        """The schedule for these views; `passes` overrides that of the settings, which also have a least count;
        `first_rate`: learning rates of the first visit; below 1 the map only settles, and keeps its Gaussians."""
        # Read once: views may be on disk.
        reliability, shares = np.array([(float(v.trust.mean()), v.shown) for v in views]).T
        shown = max(float(shares.mean()), MIN_SHOWN)
        visits = round((settings.passes if passes is None else passes) * len(views) / shown)
        if passes is None:
            visits = max(visits, settings.min_iterations)
        steps = (WINDOW_STEPS + 1) * len(views) if seeding else 0
        overlap = overlaps(v.posed_depth() for v in views)
        return Schedule(seed, len(views), steps, visits, overlap, reliability, first_rate)

    @property
    def grows(self) -> bool:
        """Whether Gaussians come and go, rather than only settle."""
        return self.first_rate == 1

    @property
    def total(self) -> int:
        """Total number of steps."""
        return self.seeding + self.visits

    def step(self, iteration: int) -> Step:
        """Return the step of this iteration."""
        return self._seeding_step(iteration) if iteration < self.seeding else self._visit(iteration)

    def _seeding_step(self, iteration: int) -> Step:
        """The new keyframe first, then in turn one that sees the same and one of all past ones."""
        per_view = WINDOW_STEPS
        if iteration >= per_view * self.views:
            return self._filling_step(iteration - per_view * self.views)
        now, nth = divmod(iteration, per_view)
        rng = np.random.default_rng([self.seed, 1, iteration])
        view = now
        if nth > 0 and now > 0:
            view = self._covisible(now, rng) if nth % 2 else int(rng.integers(now))
        weights = keyframe_weights(now, self.reliability, TIME_DECAY, RELIABILITY_DECAY)
        seed = Seeding.TRUSTED if nth == 0 else Seeding.NOTHING
        return Step(view, float(weights[view]), 1.0, True, seed)

    def _filling_step(self, view: int) -> Step:
        weights = keyframe_weights(0, self.reliability, 0.0, RELIABILITY_DECAY)
        return Step(view, float(weights[view]), 1.0, True, Seeding.REST)

    def _covisible(self, now: int, rng: np.random.Generator) -> int:
        row = slice(*self.overlap.indptr[now : now + 2])
        others, overlap = self.overlap.indices[row], self.overlap.data[row]
        # η > 0.08 of the paper; where nobody sees the same, anybody will do.
        seeing = (others < now) & (overlap > 0.08)
        if not seeing.any():
            return int(rng.integers(now))
        return int(rng.choice(others[seeing], p=overlap[seeing] / overlap[seeing].sum()))

    def _kind_of_pass(self, number: int) -> tuple[bool, bool]:
        """Whether the pass is coarse, and whether the map grows in it: by whole passes, or half of the views would get
        Gaussians and the others none."""
        passes = self.visits / self.views
        coarse_passes = round(COARSE_SHARE * passes) if self.seeding > 0 else 0
        if number < coarse_passes:
            return True, False
        turn = (number - coarse_passes) % DENSIFY_EVERY == 0
        return False, turn and number < DENSIFY_UNTIL * passes and self.grows

    def _visit(self, iteration: int) -> Step:
        visit = iteration - self.seeding
        number, place = divmod(visit, self.views)
        view = int(np.random.default_rng([self.seed, 2, number]).permutation(self.views)[place])
        share = visit / max(self.visits, 1)
        coarse, grows = self._kind_of_pass(number)
        notes, last = grows or (number > 0 and self._kind_of_pass(number - 1)[1]), place == self.views - 1
        weights = keyframe_weights(0, self.reliability, 0.0, RELIABILITY_DECAY)
        return Step(
            view=view,
            weight=float(weights[view] / weights.mean()),
            rate=self.first_rate * (RATE_DECAY / self.first_rate) ** share,
            coarse=coarse,
            grow=grows,
            note=notes,
            split=grows and last,
            prune=notes and last,
            refine_pose=view != 0,
        )


def keyframe_weights(
    now: int, reliability: NDArray[np.float64], time_decay: float, reliability_decay: float
) -> NDArray[np.float64]:
    """(N,) eq. (13) with ρ = 1: exp(-τ (now - t)) exp(-δ (1 - mean U)), eq. (14); `reliability` (N,) is mean U."""
    age = np.maximum(now - np.arange(len(reliability)), 0)
    return np.exp(-time_decay * age) * np.exp(-reliability_decay * (1 - reliability))


class MapOptimiser:
    """One visit at a time: draw a view, compare, step; and now and then grow and prune."""

    def __init__(
        self,
        views: Sequence[View],
        classes: int,
        settings: MappingConfig,
        state: OptimiserState,
    ) -> None:
        self.views, self.settings, self.state = views, settings, state
        self.halves = LruSequence(len(views), lambda i: half_view(views[i]), lambda v: v.nbytes, HALVES_ROOM)
        self.unit = scene_depth(views)
        self.objective = Objective(settings, self.unit)
        self.growth = Growth(views, classes, settings, state, self.unit)

    def step(self, step: Step) -> None:
        """One optimisation step on one view: seed, compare, grow, prune."""
        view = (self.halves if step.coarse else self.views)[step.view]
        if step.seed is not Seeding.NOTHING:
            self._seed(step.view, step.seed)
        if len(self.state.parameters) == 0:
            return
        rendering = self._descend(step, view)
        if step.grow:
            self.growth.grow(step.view, Rendering(*(x.detach() for x in vars(rendering).values())))
        if step.split:
            self.growth.split()
        if step.prune:
            self.growth.prune(by_weight=True)

    def _descend(self, step: Step, view: View) -> Rendering:
        """Compare and move the map, the view's pose and its exposure; returns what the view showed before."""
        parameters, on_card = self.state.parameters, gpu.supports_triton(self.state.parameters["means"])
        pose, radii = self.state.cam_from_world(step.view, view), torch.exp(parameters["log_radii"].detach())
        seeing = (parameters["means"].detach(), radii, pose, view.intrinsics)
        rows, seen = None, None
        if on_card:  # a list of rows would keep the host waiting for its length
            seen, pose = marked_in_view(*seeing), pose.to(radii)
            values = {k: parameters[k] for k in KEYS}
        else:  # what the view does not show has no gradient and would wait anyway
            rows = in_view(*seeing)
            values = {k: parameters[k].detach().index_select(0, rows).requires_grad_() for k in KEYS}
        refines = self.settings.refine_poses and step.refine_pose
        stats = GaussianStats(view.scene) if step.note else None
        rendering = self.draw(view, pose.requires_grad_(refines), values, stats)
        self._expose(step.view, view, rendering)
        if stats is not None:
            stats.errors = self._color_errors(step.view, view, rendering.features)
        exposure = self.state.exposures[step.view]
        loss = self._loss(view, exposure, rendering, values["log_radii"], seen) * step.weight
        of_map, of_view = gradients_of(loss, (values, {"pose": pose} if refines else {}))
        if stats is not None:
            self._note(stats, rows, view, pose, values)
        rates = {key: rate * step.rate for key, rate in MAP_RATES.items()}
        parameters.table.step(of_map, rates, self._shares(rows, values["log_radii"].detach()), rows)
        self.state.step_pose(step.view, view, of_view.get("pose"), POSE_RATE * step.rate, self.unit)
        return rendering

    def _loss(
        self, view: View, exposure: Tensor, rendering: Rendering, log_radii: Tensor, in_view: Tensor | None
    ) -> Tensor:
        """See `Objective`; on a card the log radii are of all Gaussians, of which `in_view` (M,) bool tells who is."""
        if in_view is None:
            return self.objective.of(view, exposure, rendering, log_radii)
        from .cuda_losses import card_loss  # imports triton

        return card_loss(self.objective, view, exposure, rendering, log_radii, in_view)

    def solve_colors(self) -> None:
        """Move the colours towards those that all views together want, all else given: the first step of conjugate
        gradients (Hestenes and Stiefel 1952) of linear least squares, scaled by the pixels that each fills."""
        colors = self.state.parameters["colors"].detach()
        left, filled = torch.zeros_like(colors), torch.full_like(colors[:, :1], _HARDLY_SEEN)
        for index, view in enumerate(self.views):
            rows, own, shown, stats = self._shown(index, view, colors)
            stats.errors = torch.ones_like(shown[..., 0])
            wanted = view.of_scene(view.colors - self.state.exposures[index, 1] - shown.detach())
            left.index_add_(0, rows, torch.autograd.grad(shown, own, wanted)[0])
            filled.index_add_(0, rows, stats.error_share[:, None])
        way = left / filled
        with torch.no_grad():
            seen = (view.of_scene(self._shown(index, view, way)[2]) for index, view in enumerate(self.views))
            squared = torch.stack([image.square().sum() for image in seen]).sum().clamp(min=1e-30)
            self.state.parameters["colors"].add_((left * way).sum() / squared * way)

    def _shown(self, index: int, view: View, colors: Tensor) -> tuple[Tensor, Tensor, Tensor, GaussianStats]:
        """Indices (n,) of the Gaussians in view, their rows of `colors` (M, 3), and the image (H, W, 3) of these in the
        view's exposure, less its offset; the statistics are filled by the way back from there."""
        fixed, stats = {k: self.state.parameters[k].detach() for k in KEYS}, GaussianStats()
        pose = self.state.cam_from_world(index, view)
        rows = in_view(fixed["means"], torch.exp(fixed["log_radii"]), pose, view.intrinsics)
        values = {k: v.index_select(0, rows) for k, v in {**fixed, "colors": colors}.items()}
        own = values["colors"].requires_grad_()
        drawn = self.draw(view, pose, values, stats)
        return rows, own, drawn.features[..., :3] * torch.exp(self.state.exposures[index, 0]), stats

    @torch.no_grad()
    def count_labels(self) -> None:
        """The classes of all Gaussians by the labels of all views."""
        posed = ((view, self.state.cam_from_world(i, view)) for i, view in enumerate(self.views))
        parameters = self.state.parameters
        parameters.class_logits = voted_logits(parameters.to_map(), posed)

    @torch.no_grad()
    def _seed(self, index: int, what: Seeding) -> None:
        known = len(self.state.parameters) > 0
        view = self.views[index]
        pose, values = self.state.cam_from_world(index, view), {k: self.state.parameters[k] for k in KEYS}
        self.growth.seed(index, what, self.draw(view, pose, values) if known else None)

    @torch.no_grad()
    def _note(
        self, stats: GaussianStats, rows: Tensor | None, view: View, pose: Tensor, values: Mapping[str, Tensor]
    ) -> None:
        radii = torch.exp(values["log_radii"])
        self.growth.note(stats, rows, project_map(values["means"], radii, pose, view.intrinsics)[2])

    @torch.no_grad()
    def _color_errors(self, index: int, view: View, colors: Tensor) -> Tensor:
        """(H, W) mean difference between the view's photo and the (H, W, 3) colours of the map."""
        exposure = self.state.exposures[index]
        if gpu.supports_triton(colors):
            from .cuda_losses import color_errors_on_card  # imports triton

            return color_errors_on_card(colors, view, exposure)
        return view.of_scene((expose(colors, exposure) - view.colors).abs().mean(-1))

    def _expose(self, index: int, view: View, rendering: Rendering) -> None:
        """The view's exposure by what the map shows of it now."""
        if gpu.supports_triton(rendering.silhouette):
            from .cuda_losses import fit_exposure_on_card  # imports triton

            fit_exposure_on_card(rendering, view, self.state.exposures[index])
            return
        known, shown = view.of_scene(rendering.silhouette.detach()) > SOLID, rendering.features.detach()[..., :3]
        exposure = self.state.exposures[index]
        exposure.copy_(fit_exposure(shown, view.colors, known, exposure))

    def draw(
        self, view: View, cam_from_world: Tensor, values: Mapping[str, Tensor], stats: GaussianStats | None = None
    ) -> Rendering:
        """Gaussians of raw parameters as the view sees them from (4, 4)."""
        return render(
            values["means"],
            torch.exp(values["log_radii"]),
            torch.sigmoid(values["opacity_logits"]),
            values["colors"],
            cam_from_world,
            view.intrinsics,
            stats=stats,
        )

    def _shares(self, rows: Tensor | None, log_radii: Tensor) -> dict[str, Tensor]:
        """(n,) step sizes of some rows, None for all, by confidence class (MSGS-SLAM 3.4), those of positions times the
        radius.

        The paper has small steps where depth is unreliable. Measured, the contrary helps: what stands in the wrong
        place has farther to go, and colours have to lead it there.
        """
        trust = self.state.parameters.trust
        trust = trust if rows is None else trust.index_select(0, rows)
        shares = torch.where(trust > LOW_RELIABILITY, math.sqrt(LOW_TRUST_STEP), LOW_TRUST_STEP)
        shares = torch.where(trust > HIGH_RELIABILITY, 1.0, shares)
        return {**dict.fromkeys(KEYS, shares), "means": shares * torch.exp(log_radii)}


def scene_depth(views: Sequence[View]) -> float:
    """Median proxy depth of the views, the unit of everything that must not depend on the unit of the world."""
    samples = [v.depth[::8, ::8][v.depth[::8, ::8] > 0] for v in views]
    together = torch.cat(samples)
    return float(together.median()) if len(together) else 1.0


def voted_logits(gaussian_map: GaussianMap, posed: Iterable[tuple[View, Tensor]]) -> Tensor:
    """(M, C) class logits by the labels of views, each with its pose (4, 4): a pixel gives its confidence to its class,
    shared among the Gaussians as they are blended in it; what it is unsure of is nobody's, so that the logits tell how
    sure they are."""
    votes = torch.zeros_like(gaussian_map.class_logits)
    total = votes.new_zeros(len(votes), 1)
    for view, pose in posed:
        votes.index_add_(0, *class_weights(gaussian_map, pose, view.intrinsics, view.channels, view.label_weight))
        named = (view.channels < votes.shape[1]).to(votes)
        total[:, 0] += blending_weights(gaussian_map, pose, view.intrinsics, counts=named)[0]
    # In place: a number for each class and Gaussian is a large table.
    votes.div_(total.clamp(min=_MIN_VOTES)).div_(_FLOOR).log1p_()
    unseen = total[:, 0] <= _MIN_VOTES
    votes[unseen] = gaussian_map.class_logits[unseen]
    return votes
