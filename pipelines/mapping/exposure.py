"""The exposure of a view: a gain and an offset for each colour that take the map's colours to those of its photo."""

from __future__ import annotations

import torch
from torch import Tensor

STRIDE = 4
"""Stride of the pixels that are used, in both directions."""
SOLID = 0.9
"""Of what the map covers less, its colours say nothing yet."""
LEAST = 100
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
MOST_GAIN = 5.0


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
    enough = use.sum() >= LEAST
    if exposure.device.type == "cpu" and not enough:  # a card would make the host wait for the answer
        return exposure
    x, y = (colors[part].reshape(-1, 3).double() for colors in (shown, photo))
    log_gain, offset = exposure.double()
    weight = use / (y - x * log_gain.exp() - offset).abs().clamp(min=OUTLIER)
    weight = weight / weight.sum(0)
    mean_x, mean_y = (weight * x).sum(0), (weight * y).sum(0)
    variance = (weight * (x - mean_x) ** 2).sum(0)
    gain = (weight * (x - mean_x) * (y - mean_y)).sum(0) / variance.clamp(min=1e-12)
    gain = gain.clamp(1 / MOST_GAIN, MOST_GAIN)
    told = gain**2 * variance
    log_gain = gain.log() * told / (told + RIDGE)
    found = torch.stack([log_gain, (mean_y - log_gain.exp() * mean_x) / (1 + RIDGE)]).to(exposure)
    return torch.where(enough, found, exposure)


def expose(colors: Tensor, exposure: Tensor) -> Tensor:
    """(H, W, 3) colours of the map as a view of this exposure (2, 3) shows them."""
    return colors * torch.exp(exposure[0]) + exposure[1]
