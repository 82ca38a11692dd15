"""Depth by a network that a card describes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..networks.card import Card
from ..networks.depth import network_depth
from ..networks.identity import card_identity
from ..networks.network_pass import Arrays, NetworkPass, Workplace
from ..networks.session import Network
from ..providers import DepthEstimate, DepthProvider
from ..types import Frame


class OnnxDepth(DepthProvider):
    """Depth in metres, frame by frame, whether or not the frame has a pose."""

    metric = True

    def __init__(self, card: Card, place: Workplace) -> None:
        """Opens the network. Raises InputError when it cannot be what the card says."""
        if card.task != "depth":
            raise InputError(f"{card.model}: its card says {card.task}, but proxy.depth needs a network for depth")
        self._network = Network(card, place.threads, place.device)
        self._sequence = place.sequence
        self.name = card.name
        self._tells_focal = card.kind == "points"
        self._frames: list[Frame] = []
        identity = f"{card_identity(card)} {place.sequence.intrinsics}"
        self._pass = NetworkPass(self.name, identity, place, self._compute)

    def look(self, frames: list[Frame]) -> None:
        """Run the network; what is on disk stays."""
        self._pass.run(frames)

    def prepare(self, frames: list[Frame]) -> None:
        """Run the network over all frames."""
        self.look(frames)
        self._frames = frames

    def _compute(self, image: NDArray[np.uint8]) -> Arrays:
        found = network_depth(self._network, image, self._sequence.intrinsics)
        arrays = {"depth": found.depth, "confidence": found.confidence, "invalid": np.array(found.invalid)}
        if found.normals is not None:
            arrays["normals"] = found.normals
        return arrays | ({} if found.focal is None else {"focal": np.array(found.focal)})

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return the network's depth of a frame. Raises InputError when no pixel of it is valid."""
        stored = self._pass.load(frame)
        if not (stored["depth"] > 0).any():
            raise InputError(
                f"{self.name}: frame {frame.name} got no valid depth ({int(stored['invalid'])} of the network's values "
                "are NaN or negative). Check the card, or choose another --depth provider"
            )
        return DepthEstimate(stored["depth"], stored["confidence"], int(stored["invalid"]), stored.get("normals"))

    def figures(self) -> dict[str, Any]:
        """The size of the network's input, and the focal length that its points imply, in pixels of the frames.

        The camera was calibrated from correspondences before; the network's own focal length is a check of that.
        """
        box = self._network.box(self._sequence.intrinsics.width, self._sequence.intrinsics.height)
        figures: dict[str, Any] = {"network_size": [box.box_width, box.box_height]}
        if self._tells_focal and self._frames:
            focals = [float(self._pass.load(f)["focal"]) for f in self._frames]
            enlarge = self._sequence.calibration.intrinsics.width / self._sequence.intrinsics.width
            figures["network_focal_px"] = round(float(np.median(focals)) * enlarge, 1)
        return figures
