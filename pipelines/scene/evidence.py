"""Evidence of the scale, and what pieces of it say together.

Everything is in s = log(metres per unit): sizes err by factors. A piece of evidence is a mixture of Gaussians in s and
a chance of having measured something else altogether, which makes its tails heavy.

Usual sizes of things are (metres, relative standard deviation, weight), with their sources. Standards give the sizes
that things are made to; how far real ones scatter around them is our judgement, wider than the standards' own
tolerances. Nothing here was fitted to a recording.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Sizes = tuple[tuple[float, float, float], ...]

CAMERA_OVER_FLOOR: Sizes = ((1.45, 0.12, 0.75), (1.30, 0.35, 0.25))
"""Held by somebody standing: between elbow and eye. DIN 33402-2 (adults of 18 to 65, 5th percentile of women to 95th
of men): elbow 0.96 to 1.18 m, shoulder 1.26 to 1.55 m, eye 1.44 to 1.74 m, shoes 2.5 cm more (EN ISO 3411). So mostly
1.2 to 1.7 m; the second mode is for who sits or kneels, reaches up, or is a robot."""
CAMERA_OVER_TABLE = 0.70, 0.35
"""Where the lowest surface in view is a table top and not the floor: 1.45 m less a table's height."""

CEILING_OVER_FLOOR: Sizes = ((2.55, 0.08, 0.7), (2.9, 0.2, 0.3))
"""Homes: at least 2.13 m (IRC R305.1) and 2.40 m (Musterbauordnung §47), usually built at 8 to 9 feet, 2.44 to 2.74 m.
Offices (ASR A1.2): at least 2.50 m, 2.75 m from 50 m² on, 3.00 m from 100 m² on; old houses and halls are higher."""

DOOR: Sizes = ((2.02, 0.05, 0.7), (1.75, 0.2, 0.3))
"""Leaf of 1.985 m (DIN 18101), 1.981 m (United Kingdom), 80 inches = 2.032 m (United States), the frame a little more;
the second mode is for doors of which the image has cut some off."""

TABLE: Sizes = ((0.74, 0.05, 0.55), (0.43, 0.15, 0.35), (0.90, 0.05, 0.1))
"""Desks 0.74 m (EN 527-1, type C), school tables 0.76 m (EN 1729-1, size 6), dining tables 0.71 to 0.76 m; coffee
tables 0.35 to 0.50 m, which networks call tables too; worktops."""
SEAT: Sizes = ((0.45, 0.08, 0.75), (0.60, 0.3, 0.25))
"""0.46 m (EN 1729-1, size 6), 0.40 to 0.51 m (EN 1335-1), sofas 0.38 to 0.45 m; the second mode is for arm rests,
stools and things on seats."""
BED: Sizes = ((0.52, 0.18, 1.0),)
"""Upper side of the mattress: 0.43 to 0.58 m where wheelchairs shall reach it (ADA guidance), 0.40 to 0.65 m sold."""
WORKTOP: Sizes = ((0.90, 0.04, 0.8), (0.74, 0.1, 0.2))
"""0.85 to 0.90 m (EN 1116), 36 inches = 0.914 m (United States)."""
SURFACE: Sizes = ((0.43, 0.15, 0.35), (0.74, 0.05, 0.4), (0.90, 0.06, 0.25))
"""A level surface without a name: seat or coffee table, table, worktop."""

DISTANCE: Sizes = ((1.7, 0.65, 1.0),)
"""Median distance of what an indoor video sees. Depths of NYU Depth v2, a thousand rooms filmed by hand, average 2 to
3 m; thirteen recordings of desks, offices and rooms have 0.8 to 3.8 m, 1.5 m on average, with 0.6 in the logarithm."""

TOPS = {
    "table": ("table", TABLE),
    "desk": ("desk", TABLE),
    "coffee table": ("coffee table", ((0.43, 0.15, 1.0),)),
    "bed": ("bed", BED),
    "counter": ("worktop", WORKTOP),
    "countertop": ("worktop", WORKTOP),
    "kitchen island": ("worktop", WORKTOP),
    "chair": ("chair", SEAT),
    "armchair": ("chair", SEAT),
    "swivel chair": ("chair", SEAT),
    "sofa": ("sofa", SEAT),
    "seating": ("seat", SEAT),
}
"""Class names of networks and data sets whose upper side has a usual height: the name for people, and the heights."""
THINGS = ("door", "level surface", *dict.fromkeys(label for label, _ in TOPS.values()))
"""Sources that are counted: 2 doors, 3 chairs."""
DOORS = ("door", "double door")
CEILING_HEIGHT = "ceiling"
"""The kind of evidence that only a room gives."""
FURNITURE = (*TOPS, "cabinet", "shelf", "storage", "wardrobe")
"""What a plane that is taken for the floor must not mostly be called."""
OUTDOORS = (
    "outdoors", "sky", "grass", "road", "sidewalk", "mountain", "field", "sea", "hill", "river", "skyscraper",
    "dirt track",
)  # fmt: skip
"""The group of the networks and the classes of ADE20K in it, which a room shows through its windows at most."""

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
