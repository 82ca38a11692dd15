"""`msgs-slam doctor`: a line for each thing the program needs, and what to do where it is missing."""

import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click

from ..formats.errors import install_command
from .output import say

DISTRIBUTION = "msgs-slam"
GOOD, NOTE, BAD = "ok", "note", "BAD"
_MODULES = (
    "torch", "cv2", "pycolmap", "numba", "onnxruntime", "scipy", "skimage", "PIL", "trimesh", "safetensors"
)  # fmt: skip
_MIN_MEMORY, _MIN_DISK = 4.0, 3.0
"""Gigabytes: the largest run of the benchmarks peaks at 1.8 and fills 0.5."""


@dataclass(frozen=True)
class Finding:
    """Result of a check; `fix` says what to type or change, "" where nothing needs to be."""

    state: str
    text: str
    fix: str = ""
    name: str = ""


@click.command()
def doctor() -> None:
    """Check this machine and suggest fixes.

    Exit code 1 if something would keep a reconstruction from running.

    \b
    Example: msgs-slam doctor
    """
    findings = examine(Path("."))
    print_findings(findings)
    if any(f.state == BAD for f in findings):
        sys.exit(1)


def print_findings(findings: Sequence[Finding]) -> None:
    """Print a line for each finding, another for what to do."""
    width = max(len(f.name) for f in findings)
    for f in findings:
        say(f"{f.state:4}  {f.name:{width}}  {f.text}")
        if f.fix:
            say(f"{'':4}  {'':{width}}  fix: {f.fix}")


def examine(folder: Path) -> list[Finding]:
    """Every check in order; `folder` is where runs would be written. Never raises: what fails is a finding."""
    checks: dict[str, Callable[[], Finding]] = {
        "program": _program, "requirements": _requirements, "libraries": _libraries, "video": _video,
        "threads": _threads, "memory": _memory, "gpu": _gpu, "models": _models, "compiled kernels": _kernels,
        "disk": lambda: _disk(folder),
    }  # fmt: skip
    return [replace(_guarded(check), name=name) for name, check in checks.items()]


def _guarded(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:  # the whole point is to go on and say it
        return Finding(BAD, f"the check itself failed: {type(error).__name__}: {error}")


def _program() -> Finding:
    python = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    try:
        return Finding(GOOD, f"{DISTRIBUTION} {importlib.metadata.version(DISTRIBUTION)}, {python}")
    except importlib.metadata.PackageNotFoundError:
        return Finding(NOTE, f"run from its sources, {python}", f"{install_command('.')} in the folder of the sources")


def _requirements() -> Finding:
    """Versions against those that the installed package asks for."""
    from packaging.requirements import Requirement

    try:
        wanted = [Requirement(text) for text in importlib.metadata.requires(DISTRIBUTION) or ()]
    except importlib.metadata.PackageNotFoundError:
        return Finding(NOTE, "unknown: the program is not installed", install_command("."))
    wrong = {}
    for r in (r for r in wanted if r.marker is None or r.marker.evaluate({"extra": ""})):
        try:
            version = importlib.metadata.version(r.name)
            if not r.specifier.contains(version, prereleases=True):
                wrong[f"{r.name}{r.specifier}"] = f"{r.name} is {version}, wanted {r.specifier}"
        except importlib.metadata.PackageNotFoundError:
            wrong[f"{r.name}{r.specifier}"] = f"{r.name} is missing"
    if wrong:
        return Finding(BAD, "; ".join(wrong.values()), install_command(*wrong))
    return Finding(GOOD, "all packages present, versions compatible")


def _libraries() -> Finding:
    """That each one loads: a wheel for another processor or a missing system library shows here."""
    broken = []
    for name in _MODULES:
        try:
            importlib.import_module(name)
        except Exception as error:  # a broken wheel raises anything
            broken.append(f"{name} ({(str(error).splitlines() or [type(error).__name__])[0]})")
    if broken:
        return Finding(BAD, "do not load: " + ", ".join(broken), install_command("--force-reinstall", "PACKAGE"))
    import torch

    return Finding(GOOD, f"all libraries load; torch {torch.__version__}")


def _video() -> Finding:
    """A few frames through the encoder and back."""
    import numpy as np

    from ..formats.video import VideoReader
    from ..formats.video_streams import write_video

    frames = [np.full((48, 64, 3), 40 * i + np.arange(64)[:, None], np.uint8) for i in range(5)]
    with tempfile.TemporaryDirectory() as folder:
        path = write_video(Path(folder) / "check.mp4", frames, 10.0)
        read = sum(1 for _ in VideoReader(path))
    if read != len(frames):
        fix = install_command("--force-reinstall", "opencv-python-headless")
        return Finding(BAD, f"{read} of {len(frames)} frames came back from an MP4", fix)
    return Finding(GOOD, "MP4 read and write work")


def _threads() -> Finding:
    from ..pipelines.system.machine import available_cpus

    cores, limit = available_cpus(), os.environ.get("OMP_NUM_THREADS", "")
    if limit.isdecimal() and 0 < int(limit) < cores:
        fix = "unset OMP_NUM_THREADS; --set run.threads=N says how many the program takes"
        return Finding(NOTE, f"{cores} cores, but OMP_NUM_THREADS={limit} holds some libraries back", fix)
    return Finding(GOOD, f"{cores} cores to use")


def _memory() -> Finding:
    from ..pipelines.system.machine import machine_memory

    size = machine_memory() / 1e9
    if size < _MIN_MEMORY:
        fix = "--set frames.max_side=480 needs less, or take a machine with more"
        return Finding(NOTE, f"{size:.1f} GB; under {_MIN_MEMORY:g} long videos may not fit", fix)
    return Finding(GOOD, f"{size:.1f} GB")


def _gpu() -> Finding:
    import torch

    from ..pipelines.system.machine import unused_card

    if unused := unused_card():
        return Finding(NOTE, *unused)
    if not torch.cuda.is_available():
        return Finding(GOOD, "none; everything runs on the CPU")
    card = torch.cuda.get_device_properties(0)
    return Finding(GOOD, f"{card.name}, {card.total_memory / 1e9:.0f} GB; --device auto takes it")


def _models() -> Finding:
    from ..pipelines.networks.registry import ModelStore

    store = ModelStore.open()
    if here := [model.name for model in store.models if store.is_here(model)]:
        return Finding(GOOD, f"{', '.join(here)} in {store.cache}")
    text = f"none in {store.cache}: without networks metres are less certain and few classes have names"
    return Finding(NOTE, text, "msgs-slam models pull")


def _kernels() -> Finding:
    from ..pipelines.system.jit import cache_root

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = cache_root()
    if folder is None:
        fix = "set NUMBA_CACHE_DIR to a folder of yours that can be written"
        return Finding(NOTE, "cannot be cached: every start compiles for about a minute", fix)
    kept = sum(1 for _ in folder.rglob("*.nbi"))
    return Finding(GOOD, f"{kept} cached in {folder}" if kept else f"will be cached in {folder}")


def _disk(folder: Path) -> Finding:
    free, place = shutil.disk_usage(folder).free / 1e9, folder.resolve()
    if not os.access(folder, os.W_OK):
        return Finding(BAD, f"{place} cannot be written", "work in another folder, or give --out")
    if free < _MIN_DISK:
        fix = "make room, or write to another disk with --out"
        return Finding(BAD, f"{free:.1f} GB free in {place}; a run takes up to {_MIN_DISK:g}", fix)
    return Finding(GOOD, f"{free:.0f} GB free in {place}")
