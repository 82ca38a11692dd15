"""Corners are followed through keyframes whose features hold the path's size badly."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.sfm.features import global_descriptor, learn_vocabulary
from msgs_slam.pipelines.sfm.flow import MIN_SHARED, Picture, bridged, weakly_connected
from msgs_slam.pipelines.sfm.matching import VerifiedPair, match_features
from msgs_slam.pipelines.types import Features

STEP = np.array([9.0, -4.0])
"""Pixels by which the scene moves from one picture to the next."""
SIZE = (160, 120)


def _pair(first: int, second: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> VerifiedPair:
    matches = np.stack([a, b], 1).astype(np.uint32)
    return VerifiedPair(first, second, matches, 3, np.zeros((3, 3, 3)))


def _picture(k: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (240, 320)).astype(np.float32), (0, 0), 2.5)
    scene = (scene - scene.min()) / np.ptp(scene) * 255
    shift = np.float32([[1, 0, STEP[0] * k - 60], [0, 1, STEP[1] * k - 60]])
    return np.round(cv2.warpAffine(scene, shift, SIZE)).astype(np.uint8)


def _features(k: int, seen: NDArray[np.float64]) -> Features:
    """Of points given in the first picture, with descriptors of their own."""
    rng = np.random.default_rng(1)
    descriptors = rng.exponential(1, (len(seen), 128))
    descriptors = (descriptors * Features.NORM / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.uint8)
    return Features(np.c_[seen + k * STEP, np.ones((len(seen), 2))].astype(np.float32), descriptors)


@pytest.fixture
def weak() -> tuple[list[Features], list[VerifiedPair]]:
    """Three pictures; twenty points match in the first two, and twenty others in the last two."""
    seen = np.random.default_rng(2).uniform([30, 30], [120, 100], (40, 2))
    rows = np.arange(20)
    return [_features(k, seen) for k in range(3)], [_pair(0, 1, rows, rows), _pair(1, 2, rows + 20, rows + 20)]


def _bridged(
    weak: tuple[list[Features], list[VerifiedPair]], picture: Callable[[int], Picture]
) -> tuple[dict[int, Features], list[VerifiedPair]]:
    found: dict[int, Features] = {}
    pairs = bridged(*weak, [1], picture, found.__setitem__)
    return found, pairs


def test_a_keyframe_is_weak_where_few_features_match_before_and_behind_it() -> None:
    many, few = np.arange(2 * MIN_SHARED), np.arange(10)
    pairs = [_pair(k, k + 1, many, many if k != 3 else many[::-1] + 5000) for k in range(6)]
    assert weakly_connected(pairs, 7, reach=8) == [4]
    skipping = [*pairs, _pair(2, 4, many, many)]  # from further off they match
    assert weakly_connected(skipping, 7, reach=8) == []
    assert weakly_connected(skipping, 7, reach=1) == [4]
    assert weakly_connected([_pair(0, 1, few, few), _pair(2, 3, few, few)], 4, reach=8) == []  # nothing to follow along


def test_corners_join_what_features_do_not(weak: tuple[list[Features], list[VerifiedPair]]) -> None:
    pairs = weak[1]
    assert weakly_connected(pairs, 3, reach=8) == [1]
    found, more = _bridged(weak, lambda k: (_picture(k), None))
    count = len(found[1]) - 40
    assert count > 40
    assert [len(found[k]) for k in range(3)] == [40 + count] * 3
    for k, pair in enumerate(more):
        assert np.array_equal(pair.matches[:20], pairs[k].matches)
        moved = found[k + 1].xy[pair.matches[20:, 1]] - found[k].xy[pair.matches[20:, 0]]
        assert np.quantile(np.linalg.norm(moved - STEP, axis=1), 0.8) < 0.1  # at the rim a corner is worse off
    assert set(more[0].matches[20:, 1]) == set(more[1].matches[20:, 0])


def test_no_corner_lies_on_what_is_left_out(weak: tuple[list[Features], list[VerifiedPair]]) -> None:
    hidden = np.zeros(SIZE[::-1], np.bool_)
    hidden[:, 80:] = True
    found, _ = _bridged(weak, lambda k: (_picture(k), hidden))
    assert len(found[1]) > 50
    assert all((found[k].xy[40:, 0] < 81).all() for k in range(3))


def test_a_corner_is_like_nothing(weak: tuple[list[Features], list[VerifiedPair]]) -> None:
    features = weak[0]
    found, _ = _bridged(weak, lambda k: (_picture(k), None))
    assert match_features(found[0], found[1]).max() < 40
    vocabulary = learn_vocabulary(features, 0)
    assert np.array_equal(global_descriptor(found[1], vocabulary), global_descriptor(features[1], vocabulary))


def test_pictures_without_corners_change_nothing(weak: tuple[list[Features], list[VerifiedPair]]) -> None:
    pairs = weak[1]
    found, more = _bridged(weak, lambda k: (np.full(SIZE[::-1], 90, np.uint8), None))
    assert [len(f) for f in found.values()] == [40] * 3
    assert all(np.array_equal(a.matches, b.matches) for a, b in zip(more, pairs, strict=True))
