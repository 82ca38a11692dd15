"""A device that is not there: tensors that claim to lie elsewhere, and refuse to meet those of the CPU as a GPU would.

The tensors hold their values on the CPU and say that they lie on `DEVICE`, torch's "meta", for which autograd needs no
backend of its own. What a GPU refuses is refused: an operation on tensors of two devices (but for numbers, explicit
copies and indices) and `.numpy()`. What a GPU allows works: `.to`, `.cpu`, `.item`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

from msgs_slam.pipelines.mapping import submap_tasks
from msgs_slam.pipelines.render import api, cpu
from msgs_slam.pipelines.render.rules import GaussianStats
from msgs_slam.pipelines.run import outcome, stages
from msgs_slam.pipelines.system import adam, gpu
from tests.plain_adam import plain_descend

DEVICE = "meta"
_COPIES = {torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default}
_NUMBER = (bool, int, float)
_MAY_INDEX = {
    torch.ops.aten.index.Tensor, torch.ops.aten.index_put.default, torch.ops.aten.index_put_.default,
    torch.ops.aten._index_put_impl_.default,
}  # fmt: skip


class WrongDeviceError(RuntimeError):
    """What a GPU would refuse with "expected all tensors to be on the same device"."""


class PretendTensor(torch.Tensor):
    """A tensor whose values lie on the CPU and that claims to lie on `DEVICE`."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> PretendTensor:
        out = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=torch.device(DEVICE), requires_grad=inner.requires_grad,
        )  # fmt: skip
        out.inner = inner
        return out

    def __repr__(self, **_: Any) -> str:
        return f"PretendTensor({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        wanted = kwargs.pop("device", None)
        if function not in _COPIES:
            _require_one_device(function, args, kwargs)
        result = function(*tree_map(_inner, args), **tree_map(_inner, kwargs))
        if function is torch.ops.aten.copy_.default:
            return args[0]
        if wanted is not None and torch.device(wanted).type == "cpu":
            return result
        return tree_map(_outer(args), result)


def _inner(value: Any) -> Any:
    if isinstance(value, PretendTensor):
        return value.inner
    if isinstance(value, torch.Tensor) and value.device.type == DEVICE:
        return torch.zeros(value.shape, dtype=value.dtype)  # the zeros that autograd's formulas make in C++
    return value


def _outer(args: Any) -> Any:
    """In-place operations answer with the tensor that they were given."""
    given = {id(a.inner): a for a in tree_flatten(args)[0] if isinstance(a, PretendTensor)}

    def wrap(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        return given[id(value)] if id(value) in given else PretendTensor(value)

    return wrap


def _require_one_device(function: Any, args: Any, kwargs: Any) -> None:
    free = args[1] if function in _MAY_INDEX else ()
    excused = {id(x) for x in tree_flatten(free)[0]}
    for value in tree_flatten((args, kwargs))[0]:
        stranger = isinstance(value, torch.Tensor) and not isinstance(value, PretendTensor)
        if stranger and value.ndim > 0 and id(value) not in excused:
            raise WrongDeviceError(f"{function}: a {tuple(value.shape)} tensor of the CPU meets one of the device")


class _Mode(TorchFunctionMode):
    """What makes a tensor on `DEVICE` makes a pretending one."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function is torch.Tensor.to and not isinstance(args[0], PretendTensor):
            target = next((x for x in (*args[1:], kwargs.get("device")) if isinstance(x, str | torch.device)), None)
            other = next((x for x in args[1:] if isinstance(x, torch.Tensor)), None)
            if isinstance(other, PretendTensor) or (target is not None and torch.device(target).type == DEVICE):
                dtype = [other.dtype] if other is not None else [x for x in args[1:] if isinstance(x, torch.dtype)]
                return PretendTensor(args[0].to(*dtype) if dtype else args[0].clone())
        if function is torch.Tensor.tolist and isinstance(args[0], PretendTensor):
            return args[0].inner.tolist()
        # Numbers that torch would make tensors of on "meta", where they have no value.
        if function in (torch.Tensor.__setitem__, torch.where) and _has_pretender(args):
            told = args[:1] if function is torch.Tensor.__setitem__ else args[1:]
            of = next((x.dtype for x in told if isinstance(x, PretendTensor)), torch.float32)
            args = tuple(PretendTensor(torch.tensor(x, dtype=of)) if isinstance(x, _NUMBER) else x for x in args)
        device = kwargs.get("device")
        if device is not None and torch.device(device).type == DEVICE and not _has_pretender(args):
            if function is torch.empty:  # torch's own rules for "meta" make the zeros of a backward pass by it
                function = torch.zeros
            return PretendTensor(function(*args, **{**kwargs, "device": "cpu"}))
        return function(*args, **kwargs)


def _has_pretender(args: Any) -> bool:
    return any(isinstance(x, PretendTensor) for x in tree_flatten(args)[0])


class PretendBackend:
    """The renderer's kernels for that device: those of the CPU, once it is sure that all tensors lie on the device."""

    @staticmethod
    def composite(*arguments: Any) -> tuple[torch.Tensor, ...]:
        """As a backend's: six tensors, width, height, the least depth, and stats or None."""
        values = [_taken(x) for x in arguments[:6]]
        return _Composite.apply(arguments[6:], *values)

    @staticmethod
    def inspect(*arguments: Any) -> tuple[torch.Tensor, ...]:
        """As a backend's."""
        return tuple(
            PretendTensor(x)
            for x in cpu.inspect(
                *(_taken(x).inner.contiguous() if isinstance(x, torch.Tensor) else x for x in arguments)
            )
        )


def _taken(value: torch.Tensor) -> Any:
    if not isinstance(value, PretendTensor):
        raise WrongDeviceError(f"the renderer got a {tuple(value.shape)} tensor of the CPU")
    return value


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rest: tuple[Any, ...], *values: PretendTensor) -> tuple[torch.Tensor, ...]:
        ctx.inputs = [v.inner.detach().contiguous().requires_grad_() for v in values]
        *size, ctx.stats = rest
        counted = None if ctx.stats is None else ctx.stats.counted
        ctx.inner_stats = None if ctx.stats is None else GaussianStats(None if counted is None else counted.inner)
        with torch.enable_grad():
            ctx.outputs = cpu.composite(*ctx.inputs, *size, ctx.inner_stats)
        return tuple(PretendTensor(x.detach()) for x in ctx.outputs)

    @staticmethod
    def backward(ctx: Any, *gradients: PretendTensor) -> tuple[Any, ...]:
        given = [g.inner.contiguous() for g in gradients]
        if ctx.stats is not None:
            ctx.inner_stats.errors = ctx.stats.errors.inner
        found = torch.autograd.grad(ctx.outputs, ctx.inputs, given, allow_unused=True)
        if ctx.stats is not None:
            noted = (ctx.inner_stats.largest, ctx.inner_stats.error_share)
            ctx.stats.largest, ctx.stats.error_share = (PretendTensor(x) for x in noted)
        return (None, *(None if g is None else PretendTensor(g) for g in found))


@contextmanager
def pretended(patch: pytest.MonkeyPatch) -> Iterator[str]:
    """Within: `DEVICE` is there, is what `auto` chooses, and the renderer has kernels for it."""
    right = api.choose_backend

    def choose(backend: str | None, example: torch.Tensor) -> Any:
        return PretendBackend if isinstance(example, PretendTensor) else right(backend, example)

    patch.setattr(api, "choose_backend", choose)
    descend = adam.descend

    def step(value: torch.Tensor, *rest: Any) -> None:
        is_plain = isinstance(value, PretendTensor) and not gpu.supports_triton(value)
        (plain_descend if is_plain else descend)(value, *rest)

    patch.setattr(adam, "descend", step)
    for user in (outcome, stages, submap_tasks):
        patch.setattr(user, "resolve_device", lambda wanted="auto": DEVICE)
    patch.setattr(torch.autograd, "_engine_run_backward", _backwards(torch.autograd._engine_run_backward))
    with _Mode():
        yield DEVICE


def _backwards(engine: Any) -> Any:
    """`torch.autograd.grad` is itself handled by the mode, which is off meanwhile: what it calls needs it again."""

    def run(*arguments: Any, **named: Any) -> Any:
        with _Mode():
            return engine(*arguments, **named)

    return run
