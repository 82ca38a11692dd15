"""Adam's step by torch's own functions: the judge of the compiled ones."""

import math

import torch
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


def plain_descend(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, steps: int, shares: Tensor | None,
    rows: Tensor | None = None,
) -> None:  # fmt: skip
    """As `pipelines.system.adam.descend`."""
    if rows is not None:
        parts = [x[rows] for x in (value, first, second)]
        plain_descend(parts[0], gradient, parts[1], parts[2], rate, steps, shares)
        for whole, part in zip((value, first, second), parts, strict=True):
            whole[rows] = part
        return
    waits = gradient == 0
    first.copy_(torch.where(waits, first, first.lerp(gradient, 1 - BETA1)))
    second.copy_(torch.where(waits, second, (second * BETA2).addcmul_(gradient, gradient, value=1 - BETA2)))
    change = first / (second.sqrt() / math.sqrt(1 - BETA2**steps) + EPSILON) * (-rate / (1 - BETA1**steps))
    change = change.masked_fill(waits, 0)
    value.add_(change if shares is None else change * shares.reshape(-1, *[1] * (value.ndim - 1)))
