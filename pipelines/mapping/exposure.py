"""Exposure of a view: gain and offset of each colour from the map to its photo, and one common exposure for submaps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
_REST = 0.5
"""Shared keyframes that a submap's own exposures weigh as much as: what neighbours say of each other is a little
biased, which would add up over a long chain of submaps. So a difference fades over about eight of them, each of which
shares about 32 keyframes with the next. With 2 a kitchen in thirds has 27.20 dB, with this 27.22."""

STRIDE = 4
"""Stride of the pixels that are used, in both directions."""
SOLID = 0.9
"""Of what the map covers less, its colours say nothing yet."""
MIN_PIXELS = 100
"""Pixels without which the exposure stays as it was."""
OUTLIER = 0.02
"""Difference of colours (0..1) from which a pixel counts the less the larger it is: light and shade on what is wrong in
the map are not the camera's."""
RIDGE = 0.003
"""Weight of no change at all beside the variance of what the view shows, in colours of the photo, and beside all pixels
for the offset: exposures are relative, and drift together with the map's colours. What is newly seen shows a little
less contrast than its photo, so that gains fall from keyframe to keyframe; a pull in colours of the map, whose contrast
then grows, would lose hold of it (on a walk of 20 minutes gains fell to the limit, and the map by 15 dB). On a surface
of one colour gain and offset say the same."""
MAX_GAIN = 5.0


@torch.no_grad()
def fit_exposure(shown: Tensor, photo: Tensor, known: Tensor, exposure: Tensor) -> Tensor:
    """(2, 3) log gain and offset by which the map's colours `shown` (H, W, 3) are nearest to `photo` (H, W, 3).

    One step of iteratively reweighted least squares towards the least absolute difference, in closed form, from
    `exposure` (2, 3); `known` (H, W) are the pixels to use. Taken whole at every visit: Adam moves an exposure by a
    few per cent in all the visits of a view together, and a camera that adapts to a window does more from one image
    to the next. Chosen on five whole recordings, two by cameras, all of which gain; a made room of 13 views, whose map
    stays far from its images, loses by it, and gains where only a third of each step is taken.
    """
    part = (slice(None, None, STRIDE),) * 2
    use = known[part].reshape(-1, 1).double()
    enough = use.sum() >= MIN_PIXELS
    if exposure.device.type == "cpu" and not enough:  # a card would make the host wait for the answer
        return exposure
    x, y = (colors[part].reshape(-1, 3).double() for colors in (shown, photo))
    log_gain, offset = exposure.double()
    weight = use / (y - x * log_gain.exp() - offset).abs().clamp(min=OUTLIER)
    weight = weight / weight.sum(0)
    mean_x, mean_y = (weight * x).sum(0), (weight * y).sum(0)
    variance = (weight * (x - mean_x) ** 2).sum(0)
    gain = (weight * (x - mean_x) * (y - mean_y)).sum(0) / variance.clamp(min=1e-12)
    gain = gain.clamp(1 / MAX_GAIN, MAX_GAIN)
    told = gain**2 * variance
    log_gain = gain.log() * told / (told + RIDGE)
    found = torch.stack([log_gain, (mean_y - log_gain.exp() * mean_x) / (1 + RIDGE)]).to(exposure)
    return torch.where(enough, found, exposure)


def expose(colors: Tensor, exposure: Tensor) -> Tensor:
    """(H, W, 3) colours of the map as a view of this exposure (2, 3) shows them."""
    return colors * torch.exp(exposure[0]) + exposure[1]


@dataclass(frozen=True)
class SeenExposures:
    """Exposures of a submap's views, the bordering ones too: frame_ids (N,), log_gains and offsets (N, 3)."""

    frame_ids: NDArray[np.int64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]


def common_exposure(seen: Sequence[SeenExposures]) -> tuple[Array, Array]:
    """(S, 3) log gains and offsets that take the colours of each submap to those of all.

    Both submaps explain the photo of a keyframe that they share: gain_s x colours_s + offset_s = gain_t x colours_t +
    offset_t. The median over such keyframes for each two submaps, least squares over all of those.
    """
    rows = [{int(i): n for n, i in enumerate(s.frame_ids)} for s in seen]
    shared = {
        (s, t): [(rows[s][i], rows[t][i]) for i in sorted(rows[s].keys() & rows[t].keys())]
        for s, t in combinations(range(len(seen)), 2)
    }
    log_gains = _least_squares(len(seen), shared, lambda s, t, i, j: seen[s].log_gains[i] - seen[t].log_gains[j])

    def apart(s: int, t: int, i: int, j: int) -> Array:
        middle = (seen[s].log_gains[i] - log_gains[s] + seen[t].log_gains[j] - log_gains[t]) / 2
        return (seen[s].offsets[i] - seen[t].offsets[j]) / np.exp(middle)

    return log_gains, _least_squares(len(seen), shared, apart)


def _least_squares(
    count: int, shared: dict[tuple[int, int], list[tuple[int, int]]], apart: Callable[[int, int, int, int], Array]
) -> Array:
    """(count, 3) values whose differences are nearest to the medians of what shared keyframes say, zero on average."""
    normal, right = _REST * np.eye(count), np.zeros((count, 3))
    for (s, t), keyframes in shared.items():
        if keyframes:
            weight, step = len(keyframes), np.median([apart(s, t, i, j) for i, j in keyframes], axis=0)
            normal[[s, t], [s, t]] += weight
            normal[[s, t], [t, s]] -= weight
            right[s] += weight * step
            right[t] -= weight * step
    return np.asarray(np.linalg.solve(normal, right), np.float64)
