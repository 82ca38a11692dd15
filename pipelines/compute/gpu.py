"""Which tensors the Triton kernels take, and how one of them is started."""

import functools
import importlib.metadata
from typing import Any

import torch
from torch import Tensor


def supports_triton(example: Tensor) -> bool:
    """Whether Triton's kernels run on tensors like this one: float32 on an NVIDIA card of compute capability 8.0 and
    more, older ones having too little shared memory."""
    if example.device.type != "cuda" or example.dtype != torch.float32:
        return False
    return torch.cuda.get_device_capability(example.device) >= (8, 0) and has_triton()


def launch(kernel: Any, programs: int, *arguments: Any, **settings: Any) -> None:
    """Start a kernel of so many programs; what it writes is among its arguments."""
    kernel[(programs,)](*arguments, **settings)


@functools.cache
def has_triton() -> bool:
    """Whether a Triton is there that compiles the kernels."""
    try:
        version = importlib.metadata.version("triton")
    except importlib.metadata.PackageNotFoundError:
        return False
    # 3.2 does not refuse the kernels but ends the process while compiling them.
    return tuple(int(part) for part in version.split(".")[:2]) >= (3, 3)
