"""Classes by a network that a card describes, made steady over the video by votes in the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.proxy.networks.card import Card
from pipelines.proxy.networks.identity import card_identity
from pipelines.proxy.networks.labels import class_token, network_labels
from pipelines.proxy.networks.network_pass import Arrays, NetworkPass, Workplace
from pipelines.proxy.networks.session import Network
from pipelines.proxy.palette import class_colors
from pipelines.proxy.providers import DepthEstimate, LabelEstimate
from pipelines.proxy.regions.votes import WorldVotes
from pipelines.types import VOID, ClassTable, Frame

_LEAST_SHARE = 0.001
"""A class on a smaller share of all pixels is noise of the network and becomes void."""


class OnnxLabels:
    """Only the classes that occur in the video are kept."""

    def __init__(self, card: Card, place: Workplace) -> None:
        """Opens the network. Raises InputError when it cannot be what the card says."""
        if card.task != "segmentation":
            raise InputError(
                f"{card.model}: its card says {card.task}, but proxy.semantics needs a segmentation network"
            )
        self._network = Network(card, place.threads, place.device)
        self._sequence = place.sequence
        self.name = card.name
        self._names = card.labels
        self._label_of = np.empty(0, np.uint8)
        self._classes = ClassTable((), ())
        self._votes: WorldVotes | None = None
        identity = f"{card_identity(card)} {place.sequence.intrinsics.width}x{place.sequence.intrinsics.height}"
        self._pass = NetworkPass(self.name, identity, place, self._compute)

    def warnings(self) -> list[str]:
        """Nothing is ever amiss."""
        return []

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """None: a network sees every frame."""
        return []

    def prepare(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Run the network, settle the classes, and let all frames vote on the classes of the places they see."""
        self._pass.run(frames)
        self._learn(frames)
        counts = np.zeros(len(self._names) + 1, np.int64)
        for frame in frames:
            counts += np.bincount(self._raw(frame)[0].ravel() + 1, minlength=len(counts))
        kept = np.flatnonzero(counts[1:] >= _LEAST_SHARE * counts.sum())
        if not 0 < len(kept) < VOID:
            raise InputError(f"{self.name}: {len(kept)} classes occur; 1 to {VOID - 1} are needed. Check the card")
        # Index 0 of the table is void: ids are stored plus one.
        self._label_of = np.full(len(self._names) + 1, VOID, np.uint8)
        self._label_of[kept + 1] = np.arange(len(kept), dtype=np.uint8)
        self._classes = ClassTable(tuple(self._names[i] for i in kept), class_colors(len(kept)))
        self._votes = WorldVotes.gather(self._sequence, frames, depth_of, self._labels, len(kept))

    def _compute(self, image: NDArray[np.uint8]) -> Arrays:
        output = self._network.run(image, self._network.box(image.shape[1], image.shape[0]))["output"]
        ids, probability = network_labels(self._network, output, image.shape[1], image.shape[0])
        arrays: Arrays = {
            "ids": (ids + 1).astype(np.uint16),
            "probability": np.round(probability * 255).astype(np.uint8),
        }
        token = class_token(self._network, output, image.shape[1], image.shape[0])
        return arrays if token is None else {**arrays, "descriptor": token}

    def _learn(self, frames: list[Frame]) -> None:
        """What has to be known of all frames before `_raw`: nothing, the network knows its classes."""

    def _raw(self, frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Class ids (-1 void) and probabilities (h, w)."""
        stored = self._pass.load(frame)
        return stored["ids"].astype(np.int64) - 1, stored["probability"].astype(np.float32) / np.float32(255)

    def _labels(self, frame: Frame) -> LabelEstimate:
        ids, probability = self._raw(frame)
        labels = self._label_of[ids + 1]
        confidence = np.where(labels == VOID, 0, probability).astype(np.float32)
        return LabelEstimate(labels, confidence, self._pass.load(frame).get("descriptor"))

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """The network's labels and the votes of the other frames together."""
        own = self._labels(frame)
        return own if self._votes is None else self._votes.combine(frame, depth, own)

    def classes(self) -> ClassTable:
        """The classes that occur, in the network's order."""
        return self._classes

    def figures(self) -> dict[str, Any]:
        """How many classes the network knows."""
        return {"network_classes": len(self._names)}
