"""The renderer's kernels: products and sums may be fused into one instruction, in the same way for any thread count."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from torch import Tensor

from ..system import jit

# No "nnan" or "ninf": comparisons with a NaN must stay what they are. "contract" lets a*b+c become one instruction.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `pipelines.system.jit.kernel`, with fused sums."""
    compiled: Callable[..., Any] = jit.kernel(function, **_OPTIONS)
    return compiled


def as_array(tensor: Tensor) -> NDArray[np.float32]:
    """The numbers of a float32 tensor of the CPU, in rows, as kernels take them; raises ValueError for other types."""
    array = tensor.detach().contiguous().numpy()
    if array.dtype != np.float32:
        raise ValueError(f"the cpu backend renders float32, got {array.dtype}")
    return array


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function that only kernels call: it becomes part of them, so it needs no way in from Python and no
    place in the cache, which would take a third of the time of compiling it."""
    called: Callable[..., Any] = register_jitable(no_cpython_wrapper=True, **_OPTIONS)(function)
    return called


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `inner`, but always a part of its caller: a call for each of many small things costs as much as the things."""
    called: Callable[..., Any] = register_jitable(no_cpython_wrapper=True, forceinline=True, **_OPTIONS)(function)
    return called
