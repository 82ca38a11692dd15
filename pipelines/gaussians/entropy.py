"""Cross-entropy of an image of class logits with its own gradient: one pass over memory, where autograd makes seven."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from msgs_slam.pipelines.gaussians.render.jit import kernel
from msgs_slam.pipelines.gaussians.render.threads import for_each

_ROWS = 16


def weighted_entropy(logits: Tensor, channels: Tensor, weight: Tensor) -> Tensor:
    """Mean over all pixels of weight * cross-entropy; differentiable in `logits` alone.

    logits (H, W, C), channels (H, W) uint8, weight (H, W). Pixels of other channels than 0..C - 1 count 0.
    float32 on a CPU takes a compiled loop, everything else plain torch.
    """
    if logits.device.type == "cpu" and logits.dtype == torch.float32:
        return _Entropy.apply(logits, channels, weight)
    return plain_entropy(logits, channels, weight)


def plain_entropy(logits: Tensor, channels: Tensor, weight: Tensor) -> Tensor:
    """The same by torch's own functions."""
    known = channels.reshape(-1) < logits.shape[-1]
    target = torch.where(known, channels.reshape(-1), 0).long()
    entropy = functional.cross_entropy(logits.reshape(-1, logits.shape[-1]), target, reduction="none")
    return (entropy * weight.reshape(-1) * known).mean()


class _Entropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, channels: Tensor, weight: Tensor) -> Tensor:
        # A rendering's logits are a slice of its features: the loop takes them as they lie.
        values = logits.detach().numpy()
        classes, weights = channels.numpy(), weight.to(torch.float32).numpy()
        gradient = np.empty(values.shape, np.float32)
        rows = np.zeros(len(values))

        def work(band: int) -> None:
            part = slice(band * _ROWS, (band + 1) * _ROWS)
            _entropy_rows(
                values[part], classes[part], weights[part], np.float32(classes.size), rows[part], gradient[part]
            )

        for_each(work, -(-len(values) // _ROWS))
        ctx.save_for_backward(torch.from_numpy(gradient))
        # Summed by rows in one order, whatever the threads.
        return torch.tensor(rows.sum() / classes.size, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return ctx.saved_tensors[0] * grads[0], None, None


@kernel
def _entropy_rows(
    logits: NDArray, channels: NDArray, weight: NDArray, pixels: float, rows: NDArray, gradient: NDArray
) -> None:
    """Into rows (h,) the summed losses, into gradient (h, W, C) that of the mean over `pixels` pixels."""
    height, width, count = logits.shape
    for y in range(height):
        total = 0.0
        for x in range(width):
            w = weight[y, x]
            own = channels[y, x]
            if w == 0 or own >= count:
                for c in range(count):
                    gradient[y, x, c] = 0
                continue
            largest = logits[y, x, 0]
            for c in range(1, count):
                largest = max(largest, logits[y, x, c])
            mass = np.float32(0)
            for c in range(count):
                share = np.exp(logits[y, x, c] - largest)
                gradient[y, x, c] = share
                mass += share
            total += w * (np.log(mass) + largest - logits[y, x, own])
            scale = w / (mass * pixels)
            for c in range(count):
                gradient[y, x, c] *= scale
            gradient[y, x, own] -= w / pixels
        rows[y] = total
