"""Classes by a network that a card describes, brought together over the video in the world; without names, clusters of
its features."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.sequence import resample_linear
from ..networks.card import Card
from ..networks.network_pass import Arrays, NetworkPass, Workplace
from ..networks.outputs import best_classes, class_token, network_probabilities, patch_features, softmax
from ..networks.session import Network, card_identity
from ..providers import DepthEstimate, LabelEstimate, SemanticsProvider, class_colors
from ..types import VOID, ClassTable, Frame
from .named import NamedScene, NetworkClasses
from .segments import Segments

_SAMPLE = 20000
_ROUNDS = 20
_SOFTNESS = 0.1
"""Cosine similarity by which a cluster must lead to be e times as likely."""
_MIN_SHARE = 0.001
"""A class on a smaller share of all pixels is noise of the network and becomes void."""
_SIDE = 160
"""Samples of the probabilities that are kept along the longer side of an image: networks give 33 to 128."""
_STEPS = 16
"""Steps of the stored probabilities in each halving: 4 %; 255 of them reach down to 2e-5."""


class OnnxLabels(SemanticsProvider):
    """Only the classes that occur in the video are kept."""

    shared_state: tuple[str, ...] = ("_label_of", "_scene")

    def __init__(self, card: Card, place: Workplace, limit: int, no_people: bool = False) -> None:
        """Open the network. Raises InputError when it cannot be what the card says.

        Args:
            card: describes the network.
            place: sequence, device, threads, cache and progress.
            limit: of numbered objects, for what has no name.
            no_people: nothing is called a person.
        """
        if card.task != "segmentation":
            raise InputError(
                f"{card.model}: its card says {card.task}, but proxy.semantics needs a segmentation network"
            )
        self._network = Network(card, place.threads, place.device)
        self._sequence = place.sequence
        self.name = card.name
        self._names, self._void = card.labels, card.void
        self._people = [i for i, name in enumerate(card.labels) if no_people and name == "person"]
        self._limit = limit
        self._progress = place.progress
        self._classes = ClassTable((), ())
        self._label_of = np.empty(0, np.uint8)
        self._scene: NamedScene | None = None
        identity = f"{card_identity(card)} {place.sequence.intrinsics.width}x{place.sequence.intrinsics.height}"
        self._pass = NetworkPass(self.name, identity, place, self._compute)
        if card.text is not None:  # no file says whether an image's features are as long as a word's
            camera = place.sequence.intrinsics
            self._compute(np.full((camera.height, camera.width, 3), 128, np.uint8))

    def precompute(self, frames: list[Frame]) -> None:
        """Run the network; what is on disk stays."""
        self._pass.run(frames)

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Let the network look, let all frames vote on the names of the places they see, and settle the classes."""
        self.precompute(frames)
        self._learn(frames)
        if self._has_world(frames, depth_of):
            segments = Segments(self._sequence, self._progress)
            vocabulary = NetworkClasses(self._names, self._void, self._limit)
            self._scene = NamedScene.gather(segments, frames, depth_of, self._probabilities, vocabulary)
            names, kept = self._scene.names, self._scene.kept
        else:
            kept = self._settle_unposed(frames)
            names = tuple(self._names[i] for i in kept)
        if not 0 < len(names) < VOID:
            raise InputError(f"{self.name}: {len(names)} classes occur; 1 to {VOID - 1} are needed. Check the card")
        self._classes = ClassTable(names, class_colors(names))

    def _has_world(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> bool:
        """Whether two frames or more with a pose have depth that can be relied on."""
        posed = [f for f in frames if f.id in self._sequence.cam_from_world]
        return sum(bool((depth_of(f).confidence > 0.3).any()) for f in posed[:: max(1, len(posed) // 10)]) >= 2

    def _settle_unposed(self, frames: list[Frame]) -> NDArray[np.int64]:
        """(K,) the classes that occur in the frames by themselves."""
        counts = np.zeros(len(self._names) + 1, np.int64)
        for frame in frames:
            counts += np.bincount(
                best_classes(self._probabilities(frame), self._void)[0].ravel() + 1, None, len(counts)
            )
        kept = np.flatnonzero(counts[1:] >= _MIN_SHARE * counts.sum())
        # Index 0 of the table is void: ids are stored plus one.
        self._label_of = np.full(len(self._names) + 1, VOID, np.uint8)
        self._label_of[kept + 1] = np.arange(len(kept), dtype=np.uint8)
        return kept

    def _compute(self, image: NDArray[np.uint8]) -> Arrays:
        height, width = image.shape[:2]
        output = self._network.run(image, self._network.box(width, height))["output"]
        neg_log2_prob = -np.log2(np.maximum(network_probabilities(self._network, output, width, height, _SIDE), 1e-9))
        arrays: Arrays = {"halvings": np.minimum(np.round(neg_log2_prob * _STEPS), 255).astype(np.uint8)}
        token = class_token(self._network, output, width, height)
        return arrays if token is None else {**arrays, "descriptor": token}

    def _learn(self, frames: list[Frame]) -> None:
        """Learn from all frames what `_probabilities` needs: nothing, the network knows its classes."""

    def _probabilities(self, frame: Frame) -> NDArray[np.float32]:
        """(rows, columns, C) over the whole image; 0 where the network says nothing."""
        neg_log2_prob = self._pass.load(frame)["halvings"]
        said = np.exp2(-neg_log2_prob.astype(np.float32) / np.float32(_STEPS))
        said = np.where(neg_log2_prob.min(-1, keepdims=True) < 255, said, 0).astype(np.float32)
        said[..., self._people] = 0
        return said

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Return labels fused over all frames that see the same places; without a world, this frame's alone."""
        own = self._probabilities(frame)
        if self._scene is not None:
            found = self._scene.estimate(self._sequence, frame, depth, own)
        else:
            ids, probability = best_classes(resample_linear(own, *depth.depth.shape), self._void)
            labels = self._label_of[ids + 1]
            found = LabelEstimate(labels, np.where(labels == VOID, 0, probability).astype(np.float32))
        return replace(found, descriptor=self._pass.load(frame).get("descriptor"))

    def classes(self) -> ClassTable:
        """The classes that occur, in the network's order, then the objects that it has no name for."""
        return self._classes

    def figures(self) -> dict[str, Any]:
        """The names that the network knows, whether or not they occur."""
        return {"vocabulary": [n for i, n in enumerate(self._names) if i not in self._void]}


class OnnxClusters(OnnxLabels):
    """Classes by clustering features: "cluster 1" is the most frequent; spherical k-means with a fixed seed."""

    shared_state = (*OnnxLabels.shared_state, "_centres")

    def __init__(self, card: Card, place: Workplace, limit: int) -> None:
        """`limit` clusters at the most. Raises InputError as `OnnxLabels`."""
        super().__init__(card, place, limit)
        self._centres = np.empty((0, 0), np.float32)

    def _compute(self, image: NDArray[np.uint8]) -> Arrays:
        height, width = image.shape[:2]
        output = self._network.run(image, self._network.box(width, height))["output"]
        arrays = {"features": patch_features(self._network, output, width, height).astype(np.float16)}
        token = class_token(self._network, output, width, height)
        return arrays if token is None else {**arrays, "descriptor": token}

    def _learn(self, frames: list[Frame]) -> None:
        rng = np.random.default_rng(0)
        each = max(1, _SAMPLE // max(len(frames), 1))
        rows = []
        for frame in frames:
            features = self._features(frame)
            features = features.reshape(-1, features.shape[-1])
            rows.append(features[rng.permutation(len(features))[:each]])
        centres = spherical_kmeans(np.concatenate(rows), self._limit, rng)
        self._centres = centres
        self._names = tuple(f"cluster {i + 1}" for i in range(len(centres)))

    def _features(self, frame: Frame) -> NDArray[np.float32]:
        """(rows, columns, F) unit vectors."""
        features = self._pass.load(frame)["features"].astype(np.float32)
        return features / np.maximum(np.linalg.norm(features, axis=-1, keepdims=True), 1e-6)

    def _probabilities(self, frame: Frame) -> NDArray[np.float32]:
        camera = self._sequence.intrinsics
        box = self._network.box(camera.width, camera.height)
        small = replace(box, width=max(1, camera.width // 4), height=max(1, camera.height // 4))
        return softmax(small.take((self._features(frame) @ self._centres.T) / np.float32(_SOFTNESS)))


def spherical_kmeans(vectors: NDArray[np.float32], limit: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(k, F) unit centres of unit vectors (Q, F), the largest cluster first; k <= limit, fewer when vectors repeat.

    Started far apart, each centre at the vector that the ones before it say least of.
    """
    centres = vectors[rng.integers(len(vectors))][None]
    while len(centres) < limit:
        nearest = (vectors @ centres.T).max(1)
        if nearest.min() > 1 - 1e-4:
            break
        centres = np.concatenate([centres, vectors[nearest.argmin()][None]])
    for _ in range(_ROUNDS):
        member = (vectors @ centres.T).argmax(1)
        sums = np.zeros(centres.shape, np.float64)
        np.add.at(sums, member, vectors)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        centres = np.where(length > 0, sums / np.maximum(length, 1e-12), centres).astype(np.float32)
    counts = np.bincount((vectors @ centres.T).argmax(1), minlength=len(centres))
    order = np.argsort(-counts, kind="stable")
    return np.ascontiguousarray(centres[order][counts[order] > 0])
