"""Where dense work runs: decided here, once a command."""

from __future__ import annotations

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.system.progress import log


def settle_device(wanted: str = "auto") -> str:
    """ "cpu" or "cuda": `auto` takes a GPU if there is one. Raises InputError for a GPU that is not there."""
    import torch

    found = torch.cuda.is_available()
    if wanted == "cuda" and not found:
        raise InputError(
            "--device cuda: torch finds no CUDA device here. Use --device cpu, or install a CUDA build of torch"
        )
    if wanted != "auto":
        return wanted
    log.info("device: %s", "cuda" if found else "cpu")
    return "cuda" if found else "cpu"
