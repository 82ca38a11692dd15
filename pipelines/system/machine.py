"""Resources of this machine: its device, memory and CPUs, and the parts of a long recording that fit."""

import ctypes
import functools
import importlib.metadata
import math
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil

from ...formats.errors import InputError, install_command
from ..config import Config
from ..types import Intrinsics
from .progress import log

_CGROUPS, _OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")

_FRAMES = (380, 640, 1.7)
"""MB that structure from motion needs at its peak: at least, for each million pixels of a frame, for each keyframe."""
_MAPPING = (445, 350, 1970)
"""MB that mapping needs: at least, for each million pixels of a frame, for each million Gaussians. Both are fitted to
the peaks of 63 runs of 10 to 219 keyframes: half lie within 15 %, nine of ten within 40 %."""
_GAUSSIANS = 22_000
"""A map has about so many for each keyframe and million pixels of it."""
VIEWS_SHARE = 0.25
"""Of the memory that mapping plans with, for views; what has no room there is read again."""
WINDOW, WINDOW_OVERLAP = 500, 40
"""Keyframes of a window of structure from motion, and those that it shares with the one before. All at once is surer
(0.20 cm against 0.26 in windows of 32 of a walk of 77 keyframes, the one recording tried), while there is room."""
_MIN_WINDOW = 100
MIN_SUBMAP = 60
"""Keyframes: smaller submaps are mostly border."""
ALIGNED_TOGETHER = 200
"""Fields of depths that are solved for at once: their equations take 0.4 MB each."""
LEAST_CAPABILITY = (8, 0)
"""Compute capability of the cards that the kernels run on."""


def submap_size(config: Config, camera: Intrinsics) -> int:
    """Keyframes of a submap: `mapping.submap`, or as many as `run.memory_mb` has room for where that is given; 0 where
    all are mapped at once. What the machine has does not matter: a run is the same on every machine."""
    limit, memory_mb = config.mapping.submap, config.run.memory_mb
    if not limit or not memory_mb:
        return limit
    least, a_million_pixels, a_million_gaussians = _MAPPING
    small = camera.at_most(config.mapping.max_side)
    pixels = small.width * small.height / 1e6
    room = (1 - VIEWS_SHARE) * memory_mb - least - a_million_pixels * camera.width * camera.height / 1e6
    return min(limit, max(MIN_SUBMAP, int(room / (a_million_gaussians * _GAUSSIANS / 1e6 * pixels))))


def submap_count(keyframes: int, size: int) -> int:
    """Return into how many submaps of about that size so many keyframes are divided; one for a size of 0."""
    return max(1, round(keyframes / size)) if size else 1


def release_free_memory() -> None:
    """Hand what is free back to the system, where the C library has a call for that: glibc keeps what is between
    pieces still in use, after a window of structure from motion 40 to 190 MB."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)


def memory_room(memory_mb: int) -> float:
    """Bytes that the process may need: `run.memory_mb`, for 0 half of what the machine (or its container) has."""
    return memory_mb * 1e6 if memory_mb else machine_memory() / 2


def room_on(device: object, host: float) -> float:
    """Bytes to plan with for data on a device: on a GPU what is free there now, whatever the `host` has."""
    if not str(device).startswith("cuda"):
        return host
    import torch

    return float(torch.cuda.mem_get_info()[0])


def machine_memory() -> float:
    """Bytes of memory of the machine, or of the container where that has less."""
    return min([float(psutil.virtual_memory().total), *memory_limits()])


def available_cpus() -> int:
    """CPUs that this process may use: those of its affinity mask, and no more than a cgroup's quota pays for."""
    affine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min([affine, *(math.ceil(quota) for quota in _cpu_quotas())]))


def memory_limits() -> list[float]:
    """Bytes that each cgroup around this process allows, where it says so."""
    found = []
    for folder in _own_cgroups("memory"):
        for name in ("memory.max", "memory.limit_in_bytes"):
            with suppress(OSError, ValueError):  # no such file; "max"
                found.append(float((folder / name).read_text(encoding="ascii")))
    return found


def _cpu_quotas() -> list[float]:
    """CPUs that each cgroup's quota pays for."""
    found = []
    for folder in _own_cgroups("cpu"):
        with suppress(OSError, ValueError):
            quota, period = (folder / "cpu.max").read_text(encoding="ascii").split()
            found.append(float(quota) / float(period))
        with suppress(OSError, ValueError):
            quota, period = ((folder / f"cpu.cfs_{n}_us").read_text(encoding="ascii") for n in ("quota", "period"))
            found.append(float(quota) / float(period))
    return [quota for quota in found if quota > 0]  # -1: no limit


def _own_cgroups(controller: str) -> Iterator[Path]:
    """Yield the cgroups around this process, innermost first. The limit of a job (SLURM, systemd, Kubernetes) is set
    on one below the root; inside a container the root is the container's own, and the path may be the host's."""
    with suppress(OSError):
        for line in _OWN_CGROUPS.read_text(encoding="utf-8", errors="replace").splitlines():
            _, _, rest = line.partition(":")
            controllers, _, place = rest.partition(":")
            if controllers and controller not in controllers.split(","):
                continue
            root = _CGROUPS / controller if controllers else _CGROUPS  # version 1 has a tree for each controller
            path = Path("/", place.strip("/"))
            yield from (root / part.relative_to("/") for part in (path, *path.parents))
    yield from (_CGROUPS, _CGROUPS / controller)


def window_size(memory_mb: int, pixels: int) -> int:
    """Keyframes of a window for `run.memory_mb` and images of so many pixels; where that is not given (0) always as
    many: what comes out does not depend on the machine."""
    if memory_mb == 0:
        return WINDOW
    least, a_million_pixels, a_keyframe = _FRAMES
    return int(np.clip((memory_mb - least - a_million_pixels * pixels / 1e6) / a_keyframe, _MIN_WINDOW, WINDOW))


def windows_of(count: int, size: int = WINDOW, shared: int = WINDOW_OVERLAP) -> list[range]:
    """All keyframes in windows of about that size; one window for less than half as much again. For a size of more than
    twice what is shared none is in three windows."""
    parts = max(1, round((count - shared) / (size - shared))) if count > 1.5 * size else 1
    shared *= parts > 1
    edges = np.linspace(0, count - shared, parts + 1).round().astype(int).tolist()
    return [range(a, b + shared) for a, b in pairwise(edges)]


def resolve_device(wanted: str = "auto") -> str:
    """ "cpu" or "cuda": `auto` takes a GPU that the kernels run on, if there is one. Raises InputError where one is
    asked for and there is none."""
    fault = card_fault()
    if wanted == "cuda" and fault:
        raise InputError(f"--device cuda: {fault}. Use --device cpu, or install a CUDA build of torch")
    if wanted != "auto":
        return wanted
    return _log_once("cpu" if fault else "cuda")


def card_fault() -> str:
    """Say why no card can be used; "" where one can: older ones have too little shared memory for the kernels."""
    import torch

    if not torch.cuda.is_available():
        return "torch finds no CUDA device here"
    if (capability := torch.cuda.get_device_capability()) < LEAST_CAPABILITY:
        return f"the card has compute capability {capability[0]}.{capability[1]}, and 8.0 is needed"
    return "" if has_triton() else "there is no triton >= 3.3, which comes with torch >= 2.7 built for CUDA"


@functools.cache
def has_triton() -> bool:
    """Whether a Triton is there that compiles the kernels."""
    try:
        version = importlib.metadata.version("triton")
    except importlib.metadata.PackageNotFoundError:
        return False
    # 3.2 does not refuse the kernels but ends the process while compiling them.
    return tuple(int(part) for part in version.split(".")[:2]) >= (3, 3)


def require_device(wanted: str) -> None:
    """Raise InputError for a GPU that is not there."""
    if wanted == "cuda":
        resolve_device(wanted)


def unused_card() -> tuple[str, str] | None:
    """Explain why an NVIDIA card is not used, and what to do; None where there is none, or where
    CUDA_VISIBLE_DEVICES hides it."""
    import torch

    if torch.cuda.is_available():
        return (
            (f"{fault}: everything runs on the CPU", "use a newer card or torch") if (fault := card_fault()) else None
        )
    has_driver = shutil.which("nvidia-smi") or Path("/dev/nvidia0").exists()
    if not has_driver or os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
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
