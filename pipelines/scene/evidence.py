"""Evidence of the scale, and what pieces of it say together.

Everything is in s = log(metres per unit): sizes err by factors. A piece of evidence is a mixture of Gaussians in s and
a chance of having measured something else altogether, which makes its tails heavy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAME_KIND, _ANY_KIND = 0.5, 0.1
"""Correlation of the errors of two pieces of one kind (the chairs of one set, rooms of one house), and of any two,
which share poses, depth and the floor that heights are measured from."""
_SHARED_SD = 0.05
"""What all sources suffer from alike, so that no number of them averages it out: focal length, drift, depth."""
_REACH = 3.0
"""Beyond so far from all modes, in s, nothing is possible: a factor of twenty."""
_STEPS = 4001
_FARTHEST = 2.0
"""A source that is farther off, in its own sigmas, counts as so far when disagreement is measured: it is more likely
wrong altogether, which its tails allow for."""


@dataclass(frozen=True)
class Mode:
    """One way to read a measurement: with this weight, s is `log_scale` ± `sd`."""

    log_scale: float
    sd: float
    weight: float = 1.0


@dataclass(frozen=True)
class Evidence:
    """Evidence of one source on s, the logarithm of the metres per unit.

    source: its name for people; kind: evidence of one kind shares its errors; modes: weights sum to 1; wrong: the
    probability that it says nothing about the scale; `is_guess`: whether it only knows what is usual in the world.
    """

    source: str
    kind: str
    modes: tuple[Mode, ...]
    wrong: float = 0.05
    is_guess: bool = True

    def density(self, s: Array) -> Array:
        """(S,) probability density at s (S,), the unknown part flat over their range."""
        total = np.full(len(s), self.wrong / max(float(s[-1] - s[0]), 1e-9))
        for mode in self.modes:
            z = (s - mode.log_scale) / mode.sd
            total += (1 - self.wrong) * mode.weight * np.exp(-0.5 * z**2) / (mode.sd * np.sqrt(2 * np.pi))
        return np.maximum(total, np.finfo(np.float64).tiny)

    @property
    def log_scale(self) -> float:
        """Mean of the modes."""
        return float(sum(m.weight * m.log_scale for m in self.modes))

    @property
    def sd(self) -> float:
        """Standard deviation of the modes' mixture: how sure the source is if it is what it seems to be."""
        return float(np.sqrt(sum(m.weight * (m.sd**2 + (m.log_scale - self.log_scale) ** 2) for m in self.modes)))

    def distance(self, s: Array) -> Array:
        """(S,) how many of its sigmas each s is from the mode that is nearest in that measure."""
        return np.min([np.abs(s - mode.log_scale) / mode.sd for mode in self.modes], axis=0)


@dataclass(frozen=True)
class Combined:
    """s and its standard deviation; `disagreement` is the Birge ratio, 1 where the sources scatter as they say."""

    log_scale: float
    sd: float
    disagreement: float

    @property
    def factor(self) -> float:
        """Scale in metres per unit."""
        return float(np.exp(self.log_scale))


def measured(
    source: str, kind: str, length: float, sizes: Sequence[tuple[float, float, float]], **rest: float
) -> Evidence:
    """The evidence of a thing `length` units long, of which the world knows `sizes`: (metres, relative sd, weight).

    rest: `wrong`, and `length_sd`, the relative standard deviation of the measurement.
    """
    length_sd = rest.get("length_sd", 0.0)
    modes = (Mode(float(np.log(m / length)), float(np.hypot(sd, length_sd)), w) for m, sd, w in sizes)
    return Evidence(source, kind, tuple(modes), rest.get("wrong", 0.05))


def combine(pieces: Sequence[Evidence]) -> Combined:
    """The product of the densities, each to the power that correlation leaves it: its median, and an sd for which the
    ranges of 68 and of 95 % are no wider than two and four of it (a moment would be all tails).

    n Gaussians of equal sd whose errors correlate by r are worth n / (1 + r (n - 1)) independent ones. Where the
    sources scatter more than they say, the sd grows by the Birge ratio (Birge, Phys. Rev. 40, 1932): the root of chi
    squared over its degrees of freedom.
    """
    centres = [m.log_scale for p in pieces for m in p.modes]
    sharpest = min(m.sd for p in pieces for m in p.modes)
    s = np.unique(np.concatenate([
        np.linspace(min(centres) - _REACH, max(centres) + _REACH, _STEPS),
        *(c + sharpest * np.linspace(-6, 6, 241) for c in centres),
    ]))  # fmt: skip
    powers = independence(pieces)
    log_density = sum(power * np.log(p.density(s)) for p, power in zip(pieces, powers, strict=True))
    density = np.exp(log_density - np.max(log_density))
    mass = np.concatenate([[0.0], np.cumsum(np.diff(s) * (density[1:] + density[:-1]) / 2)])
    low2, low1, middle, high1, high2 = np.interp([0.02275, 0.15866, 0.5, 0.84134, 0.97725], mass / mass[-1], s)
    sd = max((high1 - low1) / 2, (high2 - low2) / 4)
    ratio = disagreement(pieces, powers, s[(s >= low2) & (s <= high2)])
    shared = _SHARED_SD if all(p.is_guess for p in pieces) else 0.0
    return Combined(float(middle), float(np.hypot(sd * max(ratio, 1.0), shared)), ratio)


def independence(pieces: Sequence[Evidence]) -> list[float]:
    """The share of each piece that is news beside the others."""
    count = Counter(p.kind for p in pieces)
    all_kinds = 1 + _ANY_KIND * (len(count) - 1)
    return [1 / (all_kinds * (1 + _SAME_KIND * (count[p.kind] - 1))) for p in pieces]


def disagreement(pieces: Sequence[Evidence], powers: Sequence[float], s: Array) -> float:
    """The Birge ratio of the pieces where, of the plausible s (S,), they agree best; 1 for fewer than two kinds.

    That a length can be read in two ways makes the density wider, and is no disagreement.
    """
    if len({p.kind for p in pieces}) < 2:
        return 1.0
    chi_squared = sum(w * np.minimum(p.distance(s), _FARTHEST) ** 2 for p, w in zip(pieces, powers, strict=True))
    return float(np.sqrt(np.min(chi_squared) / max(sum(powers) - 1, 0.5)))
