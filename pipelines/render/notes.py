"""Notes about each Gaussian that the backward pass of a rendering takes beside its gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


@dataclass
class Notes:
    """Filled by the backward pass of the M Gaussians of a rendering that is given them.

    counted (H, W) bool: the pixels whose weights count for the largest, None for all; errors (H, W) float32: of the
    pixels, to be set before that pass. Then largest (M,): the largest blending weight of each Gaussian; answered (M,):
    the errors of the pixels, weighed by the Gaussian's part in them and summed.
    """

    counted: Tensor | None = None
    errors: Tensor | None = None
    largest: Tensor = field(init=False)
    answered: Tensor = field(init=False)

    def marks(self) -> NDArray[np.float32]:
        """(2, H, W) errors, and 1 where a pixel counts; raises ValueError where nobody has set the errors."""
        if self.errors is None:
            raise ValueError("notes: the errors of the pixels have to be set before the backward pass")
        counted = torch.ones_like(self.errors) if self.counted is None else self.counted.to(self.errors)
        return np.ascontiguousarray(torch.stack([self.errors, counted]).numpy())

    def fill(self, inspect: Callable[[Tensor | None], tuple[Tensor, Tensor, Tensor]]) -> None:
        """Fill by a backend's `inspect` of what pixels count, where its backward pass does not note on its way."""
        _, self.answered, self.largest = inspect(self.errors)
        if self.counted is not None:
            self.largest = torch.minimum(self.largest, inspect(self.counted.to(self.largest))[1])
