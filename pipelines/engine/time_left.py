"""The time that a run still takes: by the work of each stage, and how fast the stages so far went on this machine."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..config import Config
from ..system.device import resolve_device
from ..system.memory import available_cpus

_PIXELS = 640 * 480
"""Of the images that the seconds below were measured on."""
_SERIAL = {"frames": 0.7, "proxy": 0.3, "tracking": 0.8, "mapping": 0.5, "global_ba": 0.8, "export": 0.5}
"""Part of a stage's seconds on one thread that more threads do not divide."""
_ON_CARD = {"proxy": 0.8, "mapping": 0.4}
"""What a CUDA card leaves of a stage's time, beside many cores."""


@dataclass(frozen=True)
class Work:
    """Seconds of each stage on one machine, for their shares alone; `text` says how much it is, or "" if not known."""

    seconds: Mapping[str, float]
    text: str = ""


USUAL = Work({"frames": 16, "proxy": 33, "tracking": 5, "mapping": 37, "global_ba": 1, "export": 8})
"""Shares before the keyframes are known: the median of five recordings (kitchen, whiteroom, the demo, two walks)."""


def work_of(config: Config, figures: Mapping[str, Any]) -> Work:
    """Work of a run by the figures of its first stage and the settings.

    Every count is of one thread's seconds, of kitchen, whiteroom_2 and staircase at each quality.
    """
    if not {"width", "height", "images", "keyframes"} <= figures.keys():
        return USUAL
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
        "frames": 0.1 * frames + keyframes * math.sqrt(whole) * (0.4 * config.frames.max_features / 3000 + 0.8),
        "proxy": keyframes * (0.4 + 1.5 * stereo * proxy.stereo_planes / 128),
        "tracking": 0.08 * frames * whole + 0.1 * keyframes,
        "mapping": 0.19 * visits * pixels(mapping.max_side) + 0.4 * keyframes,
        "global_ba": 0.03 * keyframes + 0.09 * between * whole,
        "export": 0.4 * keyframes * pixels(export.mesh_side) + 2,
    }
    threads, on_card = config.run.threads or available_cpus(), resolve_device(config.run.device) == "cuda"
    for name, serial in _SERIAL.items():
        seconds[name] *= (serial + (1 - serial) / threads) * (_ON_CARD.get(name, 1.0) if on_card else 1.0)
    side = round(max(width, height) * min(1.0, (mapping.max_side or max(width, height)) / max(width, height)))
    return Work(seconds, f"{keyframes} keyframes at {side} px")


@dataclass
class TimeLeft:
    """Time left for the stages `wanted`, in order, by the `work` of each: `seconds` of those that are done, by this
    process or another, tell how fast it goes here. As long as no stage is done nothing is known."""

    seconds: dict[str, float]
    wanted: Sequence[str]
    work: Work = USUAL
    _waiting: list[str] = field(default_factory=list)
    _begun: float | None = None

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
        done = sum(self.work.seconds[name] for name in self.seconds)
        if not done:
            return None
        speed = sum(self.seconds.values()) / done
        expected = [speed * self.work.seconds[name] for name in self._waiting]
        if self._begun is not None:
            # A stage that takes longer than estimated has still some of its time to go.
            expected[0] = max(expected[0] - (time.monotonic() - self._begun), 0.1 * expected[0])
        return sum(expected)
