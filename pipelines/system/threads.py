"""Compiled CPU kernels and the pool of threads that runs them without the GIL."""

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from torch import Tensor

from . import gpu, jit
from .machine import available_cpus

# No "nnan" or "ninf": comparisons with a NaN must stay what they are. "contract" lets a*b+c become one instruction.
_OPTIONS: dict[str, Any] = {"fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy", "no_cfunc_wrapper": True}

Floats: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int32]
Longs: TypeAlias = NDArray[np.int64]

PART = 16384
"""Gaussians that a thread takes at a time."""

_state: dict[str, int] = {"threads": 0}
_pools: dict[int, ThreadPoolExecutor] = {}


def set_threads(count: int) -> None:
    """Use `count` threads from now on, 0 for one per CPU this process may use. No result depends on it."""
    if count < 0:
        raise ValueError(f"threads: got {count}, expected >= 0")
    _state["threads"] = count


def limit_threads(threads: int) -> None:
    """Let the libraries of this process use so many CPU threads; 0 leaves it to them."""
    if threads == 0:
        return
    import cv2
    import scipy.linalg  # noqa: F401 (loads a BLAS of its own, whose threads are limited below)
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    set_threads(threads)
    # Of numpy's and scipy's BLAS: on more its sums are others, and on the small matrices here they wait for each other
    # longer than they work, on a busy machine twenty times as long. Threads of ours call it side by side.
    threadpool_limits(1, "blas")


def get_threads() -> int:
    """The number of threads in use, at least 1."""
    if _state["threads"]:
        return _state["threads"]
    return available_cpus()


def host_threads(example: Tensor) -> int:
    """The number of threads in use where our loops on the host take tensors like `example`; 1 where Triton's kernels
    take them or they lie on a card: kernels there wait for each other anyway, and Triton's interpreter has one state
    for all threads."""
    return get_threads() if example.device.type == "cpu" and not gpu.supports_triton(example) else 1


def for_each(task: Callable[[int], None], count: int) -> None:
    """Call task(0) .. task(count - 1), each once, spread over the threads; the first exception is raised."""
    helpers = min(get_threads(), count) - 1
    numbers = iter(itertools.count())  # next() on it is atomic: every number is handed out once

    def work() -> None:
        while (number := next(numbers)) < count:
            task(number)

    if helpers < 1:
        work()
        return
    futures = [_pool(helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


def _pool(size: int) -> ThreadPoolExecutor:
    """Pools are kept: starting threads costs more than a small rendering."""
    if size not in _pools:
        _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="render")
    return _pools[size]


def _forget_pools() -> None:
    """A forked child has none of its parent's threads: work handed to the old pool would never run."""
    _pools.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)


def fused_kernel(function: Callable[..., Any] | None = None, makes_arrays: bool = True) -> Callable[..., Any]:
    """Compile as `pipelines.system.jit.kernel` does, with fused sums; see `inner`."""
    if function is None:
        return functools.partial(fused_kernel, makes_arrays=makes_arrays)
    compiled: Callable[..., Any] = jit.kernel(function, _nrt=makes_arrays, **_OPTIONS)
    return compiled


def as_array(tensor: Tensor) -> NDArray[np.float32]:
    """The numbers of a float32 tensor of the CPU, in rows, as kernels take them; raises ValueError for other types."""
    array = tensor.detach().contiguous().numpy()
    if array.dtype != np.float32:
        raise ValueError(f"the cpu backend renders float32, got {array.dtype}")
    return array


def inner(function: Callable[..., Any] | None = None, makes_arrays: bool = True) -> Callable[..., Any]:
    """Compile a function that only kernels call: it becomes part of them, so it needs no way in from Python and no
    place in the cache, which would take a third of the time of compiling it. One that `makes_arrays` counts who holds
    which, in each call."""
    if function is None:
        return functools.partial(inner, makes_arrays=makes_arrays)
    called: Callable[..., Any] = register_jitable(no_cpython_wrapper=True, _nrt=makes_arrays, **_OPTIONS)(function)
    return called


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile as `inner` does, but always as a part of its caller: many small calls cost as much as their work."""
    called: Callable[..., Any] = register_jitable(no_cpython_wrapper=True, forceinline=True, **_OPTIONS)(function)
    return called
