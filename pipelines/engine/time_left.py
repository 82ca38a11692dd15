"""The time that a run still takes: by the work of each stage, and how fast the stages so far went on this machine."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ..config import STAGES, Config
from ..system.device import resolve_device
from ..system.memory import available_cpus

_PIXELS = 640 * 480
"""Of the images that the seconds below were measured on."""
_SERIAL = {"frames": 0.7, "proxy": 0.3, "tracking": 0.8, "mapping": 0.5, "global_ba": 0.8, "export": 0.5}
"""Part of a stage's seconds on one thread that more threads do not divide."""
_ON_CARD = {"proxy": 0.8, "mapping": 0.4}
"""What a CUDA card leaves of a stage's time, beside many cores."""
_DRAWING, _SECONDS_OF_DRAWING = 0.0135, 0.7
"""Seconds of one `_draw` where those below were measured, and seconds for which it is repeated."""
_TRUST = 40.0
"""Seconds of work that `machine_speed` counts as: stages that are done say more, the longer they took."""


@dataclass(frozen=True)
class Work:
    """Seconds of each stage on one machine; `text` says how much it is, or "" if not known; speed: seconds here for one
    of them, None where only shares are known."""

    seconds: Mapping[str, float]
    text: str = ""
    speed: float | None = None


USUAL = Work({"frames": 16, "proxy": 33, "tracking": 5, "mapping": 37, "global_ba": 1, "export": 8})
"""Shares before the keyframes are known: the median of five recordings (kitchen, whiteroom, the demo, two walks)."""


def _draw() -> None:
    """Draw a small map of a few thousand Gaussians, and pull a gradient back: what mapping does at each visit."""
    import torch

    from ..render.api import render
    from ..types import Intrinsics

    generator, count = torch.Generator().manual_seed(0), 20_000
    spread, corner = torch.tensor([4.0, 3.0, 3.0]), torch.tensor([-2.0, -1.5, 1.5])
    means = (torch.rand(count, 3, generator=generator) * spread + corner).requires_grad_()
    colors = torch.rand(count, 3, generator=generator).requires_grad_()
    radii, opacities = torch.full((count,), 0.02), torch.full((count,), 0.7)
    camera = Intrinsics(320, 240, 256.0, 256.0, 160.0, 120.0)
    render(means, radii, opacities, colors, torch.eye(4, dtype=torch.float64), camera).features.mean().backward()


def machine_speed() -> float:
    """Measure how many seconds this machine takes, as busy as it is, for one second of work."""
    _draw()  # compiles what is not yet
    begun, count = time.perf_counter(), 0
    while (taken := time.perf_counter() - begun) < _SECONDS_OF_DRAWING:
        _draw()
        count += 1
    return taken / max(count, 1) / _DRAWING


def work_of(config: Config, figures: Mapping[str, Any]) -> Work:
    """Work of a run by the figures of its first stage and the settings: seconds of one thread, by counts that were
    measured on kitchen, normal and as a draft."""
    if config.run.method == "paper" or not {"width", "height", "images", "keyframes"} <= figures.keys():
        return USUAL  # nothing of that kind has been measured
    frames, keyframes, images = (int(figures[k]) for k in ("frames", "keyframes", "images"))
    width, height = int(figures["width"]), int(figures["height"])

    def pixels(side: int) -> float:
        scale = min(1.0, side / max(width, height)) if side > 0 else 1.0
        return width * height * scale**2 / _PIXELS

    proxy, mapping, export = config.proxy, config.mapping, config.export
    whole, stereo = pixels(0), pixels(proxy.stereo_side)
    visits = max(mapping.passes * keyframes, mapping.min_iterations)
    between = images - frames if config.global_ba.posed == "every" else 0
    seconds = {
        "frames": 0.17 * frames + 0.6 * keyframes * math.sqrt(whole),
        "proxy": keyframes * (0.79 + 1.17 * stereo * proxy.stereo_planes / 128),
        "tracking": 0.08 * frames * whole + 0.12 * keyframes,
        "mapping": 0.167 * visits * pixels(mapping.max_side) + 0.4 * keyframes,
        "global_ba": 0.03 * keyframes + 0.08 * between * whole,
        "export": keyframes * (0.22 * pixels(export.mesh_side) + 0.08) + 2,
    }
    threads, on_card = config.run.threads or available_cpus(), resolve_device(config.run.device) == "cuda"
    for name, serial in _SERIAL.items():
        seconds[name] *= (serial + (1 - serial) / threads) * (_ON_CARD.get(name, 1.0) if on_card else 1.0)
    side = round(max(width, height) * min(1.0, (mapping.max_side or max(width, height)) / max(width, height)))
    return Work(seconds, f"{keyframes} keyframes at {side} px")


@dataclass
class TimeLeft:
    """Time left for the stages `wanted`, in order, by the `work` of each: its speed, and `seconds` of the stages that
    are done, by this process or another, tell how fast it goes here. As long as no stage is done nothing is known."""

    seconds: dict[str, float]
    wanted: Sequence[str]
    work: Work = USUAL
    _waiting: list[str] = field(default_factory=list)
    _begun: float | None = None

    def measure(self) -> None:
        """Measure this machine, once, where the work is known."""
        if self.work is not USUAL and self.work.speed is None:
            self.work = replace(self.work, speed=machine_speed())

    def begin(self, name: str) -> None:
        """Note that this stage begins: it and those after it are to be made."""
        self._waiting, self._begun = list(self.wanted[self.wanted.index(name) :]), time.monotonic()
        self.seconds = {k: v for k, v in self.seconds.items() if k not in self._waiting}

    def end(self, name: str, seconds: float) -> None:
        """Note that this stage has ended."""
        self.seconds[name], self._begun = seconds, None
        self._waiting.remove(name)

    def left(self) -> float | None:
        """Seconds to the end of all, by the time that it is now; None where nothing is known."""
        seconds, done = sum(self.seconds.values()), sum(self.work.seconds[name] for name in self.seconds)
        if self.work.speed is not None:
            # How long structure from motion takes depends on what it sees, and says little of the rest.
            seconds -= self.seconds.get(STAGES[0], 0.0) - self.work.speed * _TRUST
            done -= self.work.seconds[STAGES[0]] - _TRUST
        if done <= 0:
            return None
        speed = seconds / done
        expected = [speed * self.work.seconds[name] for name in self._waiting]
        if self._begun is not None:
            # A stage that takes longer than estimated has still some of its time to go.
            expected[0] = max(expected[0] - (time.monotonic() - self._begun), 0.1 * expected[0])
        return sum(expected)
