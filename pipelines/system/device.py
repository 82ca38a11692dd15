"""Device of dense work: decided here, by every process for itself."""

from __future__ import annotations

import functools

from ...formats.errors import InputError
from .progress import log


def resolve_device(wanted: str = "auto") -> str:
    """ "cpu" or "cuda": `auto` takes a GPU if there is one. Raises InputError for a GPU that is not there."""
    import torch

    found = torch.cuda.is_available()
    if wanted == "cuda" and not found:
        raise InputError(
            "--device cuda: torch finds no CUDA device here. Use --device cpu, or install a CUDA build of torch"
        )
    if wanted != "auto":
        return wanted
    return _told("cuda" if found else "cpu")


@functools.cache
def _told(device: str) -> str:
    log.info("device: %s", device)  # once
    return device
