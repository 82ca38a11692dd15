"""Memory planning: what stages need according to past runs, and the size of the chunks that fit."""

import ctypes
import os
import sys

from ..config import Config
from ..types import Intrinsics
from .limits import memory_limits

NEEDS = {
    "frames": (380, 640, 1.7, 0), "proxy": (750, 730, 1.8, 0), "tracking": (460, 450, 1.9, 0),
    "mapping": (445, 350, 0, 1970), "global_ba": (490, 450, 0, 500), "export": (510, 610, 0, 1310),
}  # fmt: skip
"""MB that a stage needs at its peak: at least, for each million pixels of a frame, each keyframe, each million
Gaussians. Fitted to the peaks of 63 runs of 10 to 219 keyframes and 0.01 to 0.7 million pixels: half of them lie within
15 % (global_ba 26), nine of ten within 40 %. The least of proxy is of five later runs."""
GAUSSIANS = 22_000
"""A map has about so many for each keyframe and million pixels of it."""
VIEWS_SHARE = 0.25
"""Of the memory that mapping plans with, for views; what has no room there is read again."""
LEAST_SUBMAP = 60
"""Keyframes: smaller submaps are mostly border."""
ALIGNED_TOGETHER = 200
"""Fields of depths that are solved for at once: their equations take 0.4 MB each."""
_UNKNOWN_MACHINE = 8_000_000_000


def submap_size(config: Config, camera: Intrinsics) -> int:
    """Keyframes of a submap: `mapping.submap`, or as many as `run.memory_mb` has room for where that is given; 0 where
    all are mapped at once. What the machine has does not matter: a run is the same on every machine."""
    most, memory_mb = config.mapping.submap, config.run.memory_mb
    if not most or not memory_mb:
        return most
    least, a_million_pixels, _, a_million_gaussians = NEEDS["mapping"]
    small = camera.at_most(config.mapping.max_side)
    pixels = small.width * small.height / 1e6
    room = (1 - VIEWS_SHARE) * memory_mb - least - a_million_pixels * camera.width * camera.height / 1e6
    return min(most, max(LEAST_SUBMAP, int(room / (a_million_gaussians * GAUSSIANS / 1e6 * pixels))))


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
    """Bytes of memory of the machine, or of the container where that has less; 8 GB where neither is known."""
    return min([_physical_memory(), *memory_limits()])


def _physical_memory() -> float:
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return float(_UNKNOWN_MACHINE)
