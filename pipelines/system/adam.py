"""Adam over tables of rows that come and go: values and moments under the same keys, kept aligned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import gpu
from .threads import for_each, fused_kernel

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15
_ROWS = 8192
_BLOCK = 1024
"""Numbers a program of the kernel."""


@dataclass
class AdamTable:
    """Named parameters with Adam's first and second moments (Kingma and Ba 2015) and one common step count."""

    values: dict[str, Tensor]
    first: dict[str, Tensor] = field(default_factory=dict)
    second: dict[str, Tensor] = field(default_factory=dict)
    steps: int = 0

    def __post_init__(self) -> None:
        for key, value in self.values.items():
            self.values[key] = value.detach().clone().contiguous().requires_grad_()
            # Like the copy, not like what was given: the compiled step needs moments that are contiguous too.
            self.first.setdefault(key, torch.zeros_like(self.values[key].detach()))
            self.second.setdefault(key, torch.zeros_like(self.values[key].detach()))

    def step(
        self,
        gradients: Mapping[str, Tensor | None],
        rates: Mapping[str, float],
        shares: Mapping[str, Tensor] | None = None,
        rows: Tensor | None = None,
    ) -> None:
        """One Adam step for the parameters that have a gradient and a rate.

        `rows` (n,): indices, each once, of those that gradients and shares belong to, None for all. `shares`, (n,)
        each: how much of the step each of them takes, all of it where there are none.
        """
        self.steps += 1
        for key, value in self.values.items():
            gradient, rate = gradients.get(key), rates.get(key, 0.0)
            if gradient is not None and rate != 0:
                share = None if shares is None else shares.get(key)
                moments = self.first[key], self.second[key]
                descend(value.detach(), gradient, *moments, rate, self.steps, share, rows)

    def keep(self, rows: Tensor) -> None:
        """Keep only the given rows: (M,) bool or indices."""
        for table in (self.first, self.second):
            for key in table:
                table[key] = table[key][rows].contiguous()
        for key, value in self.values.items():
            self.values[key] = value.detach()[rows].contiguous().requires_grad_()

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows with empty moments."""
        for key, value in self.values.items():
            self.values[key] = torch.cat([value.detach(), rows[key]]).contiguous().requires_grad_()
            for table in (self.first, self.second):
                table[key] = torch.cat([table[key], torch.zeros_like(rows[key])]).contiguous()

    def to_tensors(self, prefix: str) -> dict[str, Tensor]:
        """A flat table for a snapshot; `from_tensors` is the inverse."""
        out = {f"{prefix}.steps": torch.tensor(self.steps)}
        for key, value in self.values.items():
            out[f"{prefix}.{key}"] = value.detach()
            out[f"{prefix}.first.{key}"] = self.first[key]
            out[f"{prefix}.second.{key}"] = self.second[key]
        return out

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], prefix: str, keys: tuple[str, ...]) -> AdamTable:
        """Return what `to_tensors` was given."""
        return AdamTable(
            {k: tensors[f"{prefix}.{k}"] for k in keys},
            {k: tensors[f"{prefix}.first.{k}"] for k in keys},
            {k: tensors[f"{prefix}.second.{k}"] for k in keys},
            int(tensors[f"{prefix}.steps"]),
        )


def gradients_of(loss: Tensor, tables: Sequence[Mapping[str, Tensor]]) -> list[dict[str, Tensor | None]]:
    """The loss's gradients by the values of each table; None for what it does not depend on.

    Unlike backward(), which copies a gradient that is part of a larger tensor, this hands it on as it lies.
    """
    leaves = [value for table in tables for value in table.values()]
    found = iter(torch.autograd.grad(loss, leaves, allow_unused=True))
    return [{key: next(found) for key in table} for table in tables]


@torch.no_grad()
def descend(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, steps: int, shares: Tensor | None,
    rows: Tensor | None = None,
) -> None:  # fmt: skip
    """Take the `steps`-th step of Kingma and Ba 2015 on (M, ...) values and moments, in place; `shares` (n,) of it or
    all. The gradient is that of the rows (n,), of all where None. Contiguous float32 values, on a CPU by a compiled
    loop, on a card by a kernel.

    Numbers with a gradient of 0 wait, and so do their moments: most Gaussians are seen by few of the views, and would
    drift on in between by what the last of them wanted.
    """
    if gradient.numel() == 0:
        return
    width = value[0].numel()
    if width > 1 and (gradient.ndim > 2 or gradient.stride(-1) != 1):
        gradient = gradient.contiguous()
    stride = width if gradient.ndim > 2 else gradient.stride(0)
    scale, root = -rate / (1 - _BETA1**steps), 1 / math.sqrt(1 - _BETA2**steps)
    by_kernel = _descend_on_card if gpu.supports_triton(value) else _descend_on_cpu
    by_kernel(value, gradient, first, second, shares, rows, width, stride, scale, root)


def _descend_on_card(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, shares: Tensor | None, rows: Tensor | None,
    width: int, stride: int, scale: float, root: float,
) -> None:  # fmt: skip
    from .adam_kernels import descend_rows  # imports triton

    count = gradient.numel()
    # A kernel takes no None: what is not there is not read.
    given = (gradient, gradient if rows is None else rows, gradient if shares is None else shares.contiguous())
    gpu.launch(
        descend_rows, -(-count // _BLOCK), value, first, second, *given, count, width, stride, scale, root,
        BETA1=_BETA1, BETA2=_BETA2, NEW1=1 - _BETA1, NEW2=1 - _BETA2, EPSILON=_EPSILON,
        CHOSEN=rows is not None, SHARED=shares is not None, BLOCK=_BLOCK,
    )  # fmt: skip


def _descend_on_cpu(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, shares: Tensor | None, rows: Tensor | None,
    width: int, stride: int, scale: float, root: float,
) -> None:  # fmt: skip
    count = len(gradient)
    # A gradient may be some columns of a larger one: taken as one long array from its first number to its last.
    lies = torch.as_strided(gradient, (stride * (count - 1) + width,), (1,)).numpy()
    arrays = [x.numpy().reshape(-1) for x in (value, first, second)]
    chosen = np.empty(0, np.int64) if rows is None else rows.numpy()
    own = np.empty(0, np.float32) if shares is None else shares.numpy()
    factors = np.float32(scale), np.float32(root)

    def work(block: int) -> None:
        span = block * _ROWS, min(count, (block + 1) * _ROWS)
        _descend_rows(*arrays, lies, chosen, own, *span, width, stride, *factors)

    for_each(work, -(-count // _ROWS))


@fused_kernel
def _descend_rows(
    value: NDArray, first: NDArray, second: NDArray, gradient: NDArray, rows: NDArray, shares: NDArray, start: int,
    end: int, width: int, stride: int, scale: float, root: float,
) -> None:  # fmt: skip
    """The gradient's rows start to end - 1, of `width` numbers each; one starts every `stride` numbers."""
    keep1, keep2, tiny = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPSILON)
    new1, new2 = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
    for row in range(start, end):
        share = scale * shares[row] if len(shares) else scale
        at = (rows[row] if len(rows) else row) * width
        for c in range(width):
            i, g = at + c, gradient[row * stride + c]
            if g == 0:
                continue
            m = keep1 * first[i] + new1 * g
            v = keep2 * second[i] + new2 * g * g
            first[i], second[i] = m, v
            value[i] += share * m / (np.sqrt(v) * root + tiny)
