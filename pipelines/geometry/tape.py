"""The measuring tape: where a line of sight meets the map, how sure that is, and how far apart two such places are."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...formats.gaussians import GaussianCloud
from ..types import Array, Metres

_REACH = 3.0
"""Standard deviations from its middle at which a Gaussian still counts."""
_MAX_ALPHA = 0.99
_MIN_COVER = 0.5
"""Lines of sight that the map covers less meet nothing."""
_AIM_PIXELS = 1.0
"""Standard deviation of where a person clicks."""


@dataclass(frozen=True)
class Touch:
    """A place of the map: point (3,), the unit vector of the line of sight, standard deviations along and across it."""

    point: Array
    direction: Array
    along_sd: float
    across_sd: float

    def sd(self, direction: Array) -> float:
        """Return the standard deviation of the position along a unit vector (3,)."""
        share = float(self.direction @ direction) ** 2
        return float(np.sqrt(share * self.along_sd**2 + (1 - share) * self.across_sd**2))


def touch(cloud: GaussianCloud, origin: Array, direction: Array, pixel: float) -> Touch | None:
    """Find the first surface on the ray from `origin` (3,) along the unit vector `direction` (3,); None without any.

    pixel: radians of a pixel of the screen. The place is the median of the light's way, as the map blends it
    (MSGS-SLAM eqs. 4 to 7); its deviation along the line is half the span of the middle 68 % of what is blended.
    """
    depth, alpha = _crossed(cloud, origin, direction)
    order = np.argsort(depth, kind="stable")
    depth, alpha = depth[order], alpha[order]
    left = np.cumprod(np.append(1.0, 1 - alpha))
    covered = 1 - left[-1]
    if covered < _MIN_COVER:
        return None
    shares = (1 - left[1:]) / covered
    low, middle, high = (float(depth[np.searchsorted(shares, q)]) for q in (0.16, 0.5, 0.84))
    return Touch(origin + middle * direction, direction, (high - low) / 2, _AIM_PIXELS * pixel * middle)


def _crossed(cloud: GaussianCloud, origin: Array, direction: Array) -> tuple[Array, Array]:
    """(Q,) depth along the line at which each Gaussian near it is densest, and how much it covers there."""
    offset = cloud.means - origin.astype(np.float32)
    along = offset @ direction.astype(np.float32)
    beside = np.einsum("mi,mi->m", offset, offset) - along**2
    largest = np.exp(cloud.log_scales.max(axis=1))
    near = np.flatnonzero((along > 0) & (beside < (_REACH * largest) ** 2))
    turn = Rotation.from_quat(cloud.quat_wxyz[near][:, [1, 2, 3, 0]]).as_matrix()
    # In its own axes, divided by its radii, a Gaussian is a unit ball.
    whiten = turn.transpose(0, 2, 1) / np.exp(cloud.log_scales[near].astype(np.float64))[:, :, None]
    to_middle, step = np.einsum("mij,mj->mi", whiten, offset[near].astype(np.float64)), whiten @ direction
    depth = (to_middle * step).sum(1) / (step**2).sum(1)
    missed = ((to_middle - depth[:, None] * step) ** 2).sum(1)
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits[near].astype(np.float64)))
    return depth, np.minimum(opacity * np.exp(-missed / 2), _MAX_ALPHA)


def tape(first: Touch, second: Touch) -> tuple[float, float]:
    """The distance of two places and its standard deviation, the ends' errors being independent."""
    way = second.point - first.point
    length = float(np.linalg.norm(way))
    if length == 0:
        return 0.0, float(np.hypot(first.along_sd, second.along_sd))
    return length, float(np.hypot(first.sd(way / length), second.sd(way / length)))


def area(places: Array) -> float:
    """Area of the polygon of corners (N, 3) in order, seen from where it looks largest; 0 of fewer than three."""
    if len(places) < 3:
        return 0.0
    ways = places[1:] - places[0]
    return float(np.linalg.norm(np.cross(ways[:-1], ways[1:]).sum(axis=0)) / 2)


def area_text(area: float, is_metric: bool, metres: Metres | None) -> str:
    """An area in words, as `tape_text` says a length."""
    if is_metric:
        return f"{area:.3g} m²"
    text = f"{area:.3g} square units"
    if metres is None:
        return text
    return f"{text} ≈ {area * metres.per_unit**2:.2g} m² ± {200 * metres.relative_sd:.0f} %"


def tape_text(length: float, sd: float, is_metric: bool, metres: Metres | None) -> str:
    """A distance in words: metres where the world has them, else units with the metres that they are guessed to be."""
    unit_sd = metres.relative_sd if metres is not None else 0.0
    if is_metric:
        return f"{_with_sd(length, np.hypot(sd, unit_sd * length))} m"
    text = f"{_with_sd(length, sd)} units"
    if metres is None:
        return text
    guess = metres.per_unit * length, metres.per_unit * np.hypot(sd, unit_sd * length)
    return f"{text} ≈ {_with_sd(*guess)} m"


def _with_sd(value: float, sd: float) -> str:
    """1.234 ± 0.012: two digits of the deviation, the value to the same place."""
    digits = int(np.clip(1 - np.floor(np.log10(max(sd, 1e-6))), 0, 6))
    return f"{value:.{digits}f} ± {sd:.{digits}f}"
