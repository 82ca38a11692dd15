"""Rules that every backend of the renderer keeps, and statistics that its backward pass gathers of each Gaussian.

A Gaussian with opacity o and image radius s reaches the pixel centres at which f = o exp(-distance² / 2 s²) (MSGS-SLAM
eq. 4, 5) is at least ALPHA_MIN and the distance at most CUT_SIGMAS s; there it counts with min(f, ALPHA_MAX). Gaussians
are blended by increasing depth, ties by index. A pixel takes no more of them once its transmittance before the next one
is below TRANSMITTANCE_MIN. The readable renderer that judges the backends is `tests/pipelines/render/reference.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ALPHA_MIN = 1 / 255
"""Opacity at which a Gaussian ends: less cannot be seen in an 8-bit image."""

ALPHA_MAX = 0.99
"""Largest opacity at a pixel: a fully opaque Gaussian would hide all behind it from learning and divide by 0."""

TRANSMITTANCE_MIN = 1e-4

CUT_SIGMAS = 3.0
"""No Gaussian reaches farther than this many radii, however opaque."""


@dataclass
class GaussianStats:
    """Statistics of the M Gaussians of a rendering, filled by its backward pass.

    counted (H, W) bool: the pixels whose weights count for the largest, None for all; errors (H, W) float32: of the
    pixels, to be set before that pass. Then largest (M,): the largest blending weight of each Gaussian; error_share
    (M,): the errors of the pixels, weighed by the Gaussian's part in them and summed.
    """

    counted: Tensor | None = None
    errors: Tensor | None = None
    largest: Tensor = field(init=False)
    error_share: Tensor = field(init=False)

    def marks(self) -> NDArray[np.float32]:
        """(2, H, W) errors, and 1 where a pixel counts; raises ValueError where the errors are not set."""
        if self.errors is None:
            raise ValueError("stats: the errors of the pixels have to be set before the backward pass")
        counted = torch.ones_like(self.errors) if self.counted is None else self.counted.to(self.errors)
        return np.ascontiguousarray(torch.stack([self.errors, counted]).numpy())

    def fill(self, inspect: Callable[[Tensor | None], tuple[Tensor, Tensor, Tensor]]) -> None:
        """Fill by a backend's `inspect` of what pixels count, where its backward pass does not sum on its way."""
        _, self.error_share, self.largest = inspect(self.errors)
        if self.counted is not None:
            self.largest = torch.minimum(self.largest, inspect(self.counted.to(self.largest))[1])
