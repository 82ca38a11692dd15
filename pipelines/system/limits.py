"""Limits that the system sets to this process: CPUs by affinity and by quotas of cgroups, and memory by cgroups."""

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_CGROUPS, _OWN_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


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
