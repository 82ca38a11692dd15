"""Depth by a network that a card describes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from formats.errors import InputError
from pipelines.progress import Progress
from pipelines.proxy.networks.card import Card
from pipelines.proxy.networks.depth import network_depth
from pipelines.proxy.networks.session import Network
from pipelines.proxy.providers import DepthEstimate
from pipelines.proxy.scratch import load_scratch, save_scratch
from pipelines.proxy.sequence import Sequence
from pipelines.types import Frame

PLAIN_CONFIDENCE = 0.5
"""Confidence of a network that does not tell its own."""


class OnnxDepth:
    """Depth in metres, frame by frame, whether or not the frame has a pose."""

    metric = True

    def __init__(
        self, sequence: Sequence, card: Card, folder: Callable[[], Path], threads: int, device: str, progress: Progress
    ) -> None:
        """Opens the network. Raises InputError when it cannot be what the card says."""
        if card.task != "depth":
            raise InputError(f"{card.model}: its card says {card.task}, but proxy.depth needs a network for depth")
        self._network = Network(card, threads, device)
        self._sequence, self._folder, self._progress = sequence, folder, progress
        self.name = f"onnx:{card.name}"

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """None: a network sees every frame."""
        return []

    def prepare(self, frames: list[Frame]) -> None:
        """Run the network; what is on disk stays."""
        for frame in self._progress.track(frames, "network", len(frames)):
            path = self._folder() / f"{frame.id:06d}.npz"
            if not path.exists():
                depth, confidence, invalid = network_depth(
                    self._network, self._sequence.image(frame), self._sequence.intrinsics
                )
                if confidence is None:
                    confidence = np.where(depth > 0, PLAIN_CONFIDENCE, 0).astype(np.float32)
                save_scratch(path, depth=depth, confidence=confidence, invalid=np.array(invalid))

    def estimate(self, frame: Frame) -> DepthEstimate:
        """What the network said. Raises InputError when that was nothing at all."""
        stored = load_scratch(self._folder() / f"{frame.id:06d}.npz")
        if not (stored["depth"] > 0).any():
            raise InputError(
                f"{self.name}: frame {frame.name} got no valid depth ({int(stored['invalid'])} of the network's values "
                "are NaN or negative). Check the card, or choose another --depth provider"
            )
        return DepthEstimate(stored["depth"], stored["confidence"], int(stored["invalid"]))

    def figures(self) -> dict[str, Any]:
        """The size of the network's input."""
        box = self._network.box(self._sequence.intrinsics.width, self._sequence.intrinsics.height)
        return {"network_size": [box.box_width, box.box_height]}
