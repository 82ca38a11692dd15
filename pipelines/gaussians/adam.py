"""Adam over tables of rows that come and go: values and moments under the same keys, kept aligned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.gaussians.render.jit import kernel
from pipelines.gaussians.render.threads import for_each

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15
_ROWS = 8192
_TABLES = ("values", "first", "second", "made")


@dataclass
class AdamTable:
    """Named parameters with Adam's first and second moments (Kingma and Ba 2015), a step count for each name.

    Steps may be taken by some rows only: the others are behind, and catch up when they are taken next. `made`: how
    many steps each row has made, (M,) int32.
    """

    values: dict[str, Tensor]
    first: dict[str, Tensor] = field(default_factory=dict)
    second: dict[str, Tensor] = field(default_factory=dict)
    made: dict[str, Tensor] = field(default_factory=dict)
    steps: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, value in self.values.items():
            self.values[key] = value.detach().clone().contiguous().requires_grad_()
            # Like the copy, not like what was given: the compiled step needs moments that are contiguous too.
            self.first.setdefault(key, torch.zeros_like(self.values[key].detach()))
            self.second.setdefault(key, torch.zeros_like(self.values[key].detach()))
            self.made.setdefault(key, torch.zeros(len(value), dtype=torch.int32, device=value.device))
            self.steps.setdefault(key, 0)

    def step(
        self,
        gradients: Mapping[str, Tensor | None],
        rates: Mapping[str, float],
        shares: Tensor | None = None,
        rows: Tensor | None = None,
    ) -> None:
        """One Adam step for the parameters that have a gradient and a rate.

        `rows` (n,): those that the gradients belong to, as `take` gave them; None for all. `shares`: how much of the
        step each of them takes, None for all of it.
        """
        for key, value in self.values.items():
            gradient, rate = gradients.get(key), rates.get(key, 0.0)
            if gradient is not None and rate != 0:
                self.steps[key] += 1
                moments = self.first[key], self.second[key]
                descend(value.detach(), gradient, *moments, rate, self.steps[key], shares, rows)
                self.made[key][slice(None) if rows is None else rows] = self.steps[key]

    @torch.no_grad()
    def take(
        self, rows: Tensor, rates: Mapping[str, float], shares: Tensor | None = None, keys: Sequence[str] | None = None
    ) -> dict[str, Tensor]:
        """Copies of the rows (n,), to be differentiated by, after what they would have done in the steps that they took
        no part in: gradients of 0, at today's rates."""
        out = {}
        for key in keys or self.values:
            arrays = self.values[key].detach(), self.first[key], self.second[key], self.made[key]
            catch_up(*arrays, rows, rates.get(key, 0.0), self.steps[key], shares)
            out[key] = self.values[key].detach()[rows].requires_grad_()
        return out

    def keep(self, rows: Tensor) -> None:
        """Keep only the given rows: (M,) bool or indices."""
        for table in (self.first, self.second, self.made):
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
            up_to_date = self.made[key].new_full((len(rows[key]),), self.steps[key])
            self.made[key] = torch.cat([self.made[key], up_to_date])

    def to_tensors(self, prefix: str) -> dict[str, Tensor]:
        """A flat table for a snapshot; `from_tensors` is the inverse."""
        out = {f"{prefix}.steps.{key}": torch.tensor(count) for key, count in self.steps.items()}
        for name in _TABLES:
            out |= {f"{prefix}.{name}.{key}": x.detach() for key, x in getattr(self, name).items()}
        return out

    @staticmethod
    def from_tensors(tensors: Mapping[str, Tensor], prefix: str, keys: tuple[str, ...]) -> AdamTable:
        """Inverse of `to_tensors`."""
        tables = {name: {key: tensors[f"{prefix}.{name}.{key}"] for key in keys} for name in _TABLES}
        return AdamTable(**tables, steps={key: int(tensors[f"{prefix}.steps.{key}"]) for key in keys})


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
    """The `steps`-th step of Kingma and Ba 2015 on (M, ...) values and moments, in place; `shares` (n,) of it or all.
    The gradient is that of the rows (n,), of all where None.

    float32 on a CPU takes a compiled loop, one pass over memory; everything else plain torch.
    """
    if _is_fast(value):
        _descend_fast(value, gradient, first, second, rate, steps, shares, rows)
    elif rows is None:
        plain_descend(value, gradient, first, second, rate, steps, shares)
    else:
        parts = [x[rows] for x in (value, first, second)]
        plain_descend(parts[0], gradient, parts[1], parts[2], rate, steps, shares)
        for whole, part in zip((value, first, second), parts, strict=True):
            whole[rows] = part


def _is_fast(value: Tensor) -> bool:
    return (
        value.device.type == "cpu" and value.dtype == torch.float32 and value.ndim in (1, 2) and value.is_contiguous()
    )


def plain_descend(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, steps: int, shares: Tensor | None
) -> None:
    """The same by torch's own functions, on all rows."""
    first.lerp_(gradient, 1 - _BETA1)
    second.mul_(_BETA2).addcmul_(gradient, gradient, value=1 - _BETA2)
    change = first / (second.sqrt() / math.sqrt(1 - _BETA2**steps) + _EPSILON) * (-rate / (1 - _BETA1**steps))
    value.add_(change if shares is None else change * shares.reshape(-1, *[1] * (value.ndim - 1)))


def _descend_fast(
    value: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float, steps: int, shares: Tensor | None,
    rows: Tensor | None,
) -> None:  # fmt: skip
    count, width = len(gradient), value[0].numel() if len(value) else 0
    if width == 0 or count == 0:
        return
    if width > 1 and gradient.stride(-1) != 1:
        gradient = gradient.contiguous()
    stride = gradient.stride(0)
    # A gradient may be some columns of a larger one: taken as one long array from its first number to its last.
    lies = torch.as_strided(gradient, (stride * (count - 1) + width,), (1,)).numpy()
    arrays = [x.numpy().reshape(-1) for x in (value, first, second)]
    chosen = np.empty(0, np.int64) if rows is None else rows.numpy()
    own = np.empty(0, np.float32) if shares is None else shares.numpy()
    scale, root = np.float32(-rate / (1 - _BETA1**steps)), np.float32(1 / math.sqrt(1 - _BETA2**steps))

    def work(block: int) -> None:
        _descend_rows(
            *arrays, lies, chosen, own, block * _ROWS, min(count, (block + 1) * _ROWS), width, stride, scale, root,
        )  # fmt: skip

    for_each(work, -(-count // _ROWS))


@kernel
def _descend_rows(
    value: NDArray, first: NDArray, second: NDArray, gradient: NDArray, rows: NDArray, shares: NDArray, start: int,
    end: int, width: int, stride: int, scale: float, root: float,
) -> None:  # fmt: skip
    """Rows start to end - 1 of `width` numbers each; a gradient's row starts every `stride` numbers."""
    keep1, keep2, tiny = np.float32(_BETA1), np.float32(_BETA2), np.float32(_EPSILON)
    new1, new2 = np.float32(1 - _BETA1), np.float32(1 - _BETA2)
    for row in range(start, end):
        share = scale * shares[row] if len(shares) else scale
        at = rows[row] * width if len(rows) else row * width
        for c in range(width):
            i, g = at + c, gradient[row * stride + c]
            m = keep1 * first[i] + new1 * g
            v = keep2 * second[i] + new2 * g * g
            first[i], second[i] = m, v
            value[i] += share * m / (np.sqrt(v) * root + tiny)


@torch.no_grad()
def catch_up(
    value: Tensor, first: Tensor, second: Tensor, made: Tensor, rows: Tensor, rate: float, steps: int,
    shares: Tensor | None,
) -> None:  # fmt: skip
    """The steps up to `steps` that the rows (n,) have not made, with gradients of 0: one closed form.

    In k of them the moments shrink by β1^k and β2^k, and the value moves by the sum of m β1^j / sqrt(v β2^j) over j = 1
    to k, a geometric series.
    """
    ratio = _BETA1 / math.sqrt(_BETA2)
    times = np.arange(steps + 1)
    table = np.stack([_BETA1**times, _BETA2**times, ratio * (1 - ratio**times) / (1 - ratio)]).astype(np.float32)
    scale = -rate / (1 - _BETA1 ** max(steps, 1))
    root = 1 / math.sqrt(1 - _BETA2 ** max(steps, 1))
    if _is_fast(value) and len(rows):
        arrays = [x.numpy().reshape(-1) for x in (value, first, second, made)]
        own = np.empty(0, np.float32) if shares is None else shares.numpy()
        width, chosen = value[0].numel(), rows.numpy()

        def work(block: int) -> None:
            part = slice(block * _ROWS, (block + 1) * _ROWS)
            _catch_up_rows(*arrays, chosen[part], own[part], table, steps, width, np.float32(scale), np.float32(root))

        for_each(work, -(-len(chosen) // _ROWS))
        return
    missed = (steps - made[rows]).long()
    fade1, fade2, reach = torch.from_numpy(table).to(value)[:, missed].reshape(3, -1, *[1] * (value.ndim - 1))
    m, v = first[rows], second[rows]
    change = scale * reach * m / (v.sqrt() * root + _EPSILON)
    value[rows] += change if shares is None else change * shares.reshape(-1, *[1] * (value.ndim - 1))
    first[rows], second[rows], made[rows] = fade1 * m, fade2 * v, steps


@kernel
def _catch_up_rows(
    value: NDArray, first: NDArray, second: NDArray, made: NDArray, rows: NDArray, shares: NDArray, table: NDArray,
    steps: int, width: int, scale: float, root: float,
) -> None:  # fmt: skip
    tiny = np.float32(_EPSILON)
    for n in range(len(rows)):
        missed = steps - made[rows[n]]
        if missed > 0:
            share = scale * table[2, missed] * (shares[n] if len(shares) else np.float32(1))
            for i in range(rows[n] * width, rows[n] * width + width):
                m, v = first[i], second[i]
                value[i] += share * m / (np.sqrt(v) * root + tiny)
                first[i], second[i] = table[0, missed] * m, table[1, missed] * v
            made[rows[n]] = steps
