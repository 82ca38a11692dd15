"""Classes without names: clusters of a transformer's features over the whole video."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..networks.card import Card
from ..networks.labels import class_token, patch_features, softmax
from ..networks.network_pass import Arrays, Workplace
from ..types import Frame
from .learned import OnnxLabels

_SAMPLE = 20000
_ROUNDS = 20
_SOFTNESS = 0.1
"""Cosine similarity by which a cluster must lead to be e times as likely."""


class OnnxClusters(OnnxLabels):
    """Classes by clustering features: "cluster 1" is the most frequent; spherical k-means with a fixed seed."""

    of_all = (*OnnxLabels.of_all, "_centres")

    def __init__(self, card: Card, place: Workplace, most: int) -> None:
        """`most` clusters at the most. Raises InputError as `OnnxLabels`."""
        super().__init__(card, place, most)
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
        centres = spherical_kmeans(np.concatenate(rows), self._most, rng)
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


def spherical_kmeans(vectors: NDArray[np.float32], most: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(k, F) unit centres of unit vectors (Q, F), the largest cluster first; k <= most, fewer when vectors repeat.

    Started far apart, each centre at the vector that the ones before it say least of.
    """
    centres = vectors[rng.integers(len(vectors))][None]
    while len(centres) < most:
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
