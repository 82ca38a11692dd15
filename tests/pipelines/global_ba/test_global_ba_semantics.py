"""Richness and likeness of label images (eqs. 21 to 24), and VLAD."""

import numpy as np
import pytest

from msgs_slam.pipelines.global_ba.candidates import richness, similarity, structure_similarity, summarise_labels
from msgs_slam.pipelines.sfm.retrieval import describe, learn_vocabulary
from msgs_slam.pipelines.types import Features


def stripes(count: int) -> np.ndarray:
    return np.repeat(np.arange(count), 120 // count)[None].repeat(90, 0).astype(np.uint8)


def test_more_classes_and_borders_are_richer() -> None:
    summaries = [summarise_labels(stripes(n), 8) for n in (1, 2, 4, 8)]
    assert np.argsort(richness(summaries)).tolist() == [0, 1, 2, 3]
    assert summaries[0].entropy == 0
    assert summaries[3].entropy == pytest.approx(np.log(8), rel=1e-3)
    assert summaries[1].boundary < summaries[2].boundary


def test_only_the_top_tenth_is_rich() -> None:
    rng = np.random.default_rng(0)
    summaries = [
        summarise_labels(rng.integers(0, rng.integers(1, 9), (90, 120)).astype(np.uint8), 9) for _ in range(40)
    ]
    assert 1 <= (richness(summaries) > 0.9).sum() <= 5


def test_structure_knows_neighbours() -> None:
    a = summarise_labels(stripes(4), 4)
    shuffled = summarise_labels(np.array([0, 2, 1, 3], np.uint8)[stripes(4)], 4)
    same, other = structure_similarity(a.graph, np.stack([a.graph, shuffled.graph]))
    assert same == pytest.approx(1)
    assert other < 1
    weights = (0.4, 0.3, 0.3)
    same, other = similarity(a, [a, shuffled], np.array([1.0, 0.0]), weights, 0.0)
    assert same == pytest.approx(1)
    assert 0 < other < 0.6
    # What cannot pass is not compared label by label.
    assert similarity(a, [a, shuffled], np.array([1.0, 0.0]), weights, 0.7)[1] == 0


def test_the_same_place_looks_alike_and_others_by_chance() -> None:
    rng = np.random.default_rng(0)

    def seen(place: np.ndarray) -> Features:
        words = np.abs(place + rng.normal(size=place.shape) * 0.1)
        root = 512 * words / np.linalg.norm(words, axis=1, keepdims=True)
        return Features(np.zeros((len(root), 4), np.float32), np.round(root).clip(0, 255).astype(np.uint8))

    places = [np.abs(rng.normal(size=(200, 128))) for _ in range(6)]
    frames = [seen(places[i]) for i in (0, 1, 2, 3, 4, 5, 0)]
    vocabulary = learn_vocabulary(frames, 0)
    vectors = np.stack([describe(f, vocabulary) for f in frames])
    scores = vectors @ vectors[0]
    assert scores[1:6].max() < 0 < 0.5 < scores[6]
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
