"""Device of dense work: decided here, by every process for itself."""

import functools
import os
import shutil
from pathlib import Path

from ...formats.errors import InputError, install_command
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
    return _log_once("cuda" if found else "cpu")


def require_device(wanted: str) -> None:
    """Raise InputError for a GPU that is not there."""
    if wanted == "cuda":
        resolve_device(wanted)


def unused_card() -> tuple[str, str] | None:
    """An NVIDIA driver whose card torch does not find, and what to install; None where there is none, or where
    CUDA_VISIBLE_DEVICES hides it."""
    import torch

    has_driver = shutil.which("nvidia-smi") or Path("/dev/nvidia0").exists()
    if torch.cuda.is_available() or not has_driver or os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return None
    if torch.version.cuda is None:
        command = install_command("--force-reinstall", "torch<2.14")
        fix = f"install a CUDA build of torch that fits the driver (pytorch.org, Get started; on Linux: {command})"
        return "there is an NVIDIA driver, but torch is a CPU build: everything runs on the CPU", fix
    built = f"torch is built for CUDA {torch.version.cuda} and finds no device: everything runs on the CPU"
    return f"there is an NVIDIA driver, but {built}", "update the driver, or install a torch for its CUDA version"


@functools.cache
def _log_once(device: str) -> str:
    log.info("device: %s", device)  # once
    if device == "cpu" and (unused := unused_card()):
        log.warning("%s. To use the card: %s", *unused)
    return device
