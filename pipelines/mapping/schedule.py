"""Which view is visited when: a pure function of the iteration, so that a resumed run goes on as an unbroken one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..config import MappingConfig
from ..geometry.posed_depth import overlaps
from .views import View

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


class Seeding(Enum):
    """Pixels that a step seeds before it renders: none, those of trusted depth, or all remaining holes."""

    NOTHING = 0
    TRUSTED = 1
    REST = 2


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
