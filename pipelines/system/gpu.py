"""Which tensors the Triton kernels take, and how one of them is started."""

from typing import Any

import torch
from torch import Tensor

from .machine import LEAST_CAPABILITY, has_triton


def supports_triton(example: Tensor) -> bool:
    """Whether Triton's kernels run on tensors like this one: float32 on an NVIDIA card of compute capability 8.0 and
    more, older ones having too little shared memory."""
    if example.device.type != "cuda" or example.dtype != torch.float32:
        return False
    return torch.cuda.get_device_capability(example.device) >= LEAST_CAPABILITY and has_triton()


def launch(kernel: Any, programs: int, *arguments: Any, **settings: Any) -> None:
    """Start a kernel of so many programs; what it writes is among its arguments."""
    kernel[(programs,)](*arguments, **settings)
