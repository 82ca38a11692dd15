"""MSGS-SLAM eq. (2), and how alike label images are."""

import numpy as np
import pytest

from msgs_slam.pipelines.proxy.maps import EDGE_STEP, compact, mean_iou, reliability
from msgs_slam.pipelines.types import VOID, ProxyMaps

RNG = np.random.default_rng(3)
DEPTH = (2 + np.cumsum(RNG.normal(0, 0.02, (30, 40)), axis=1)).astype(np.float32)
CONFIDENCE = RNG.uniform(0, 1, DEPTH.shape).astype(np.float32)


def test_reliability_does_not_know_the_unit_of_depth() -> None:
    metres = reliability(DEPTH, CONFIDENCE)
    millimetres = reliability(DEPTH * 1000, CONFIDENCE)
    np.testing.assert_allclose(metres, millimetres, rtol=1e-4)
    assert 0 <= metres.min() < metres.max() <= 1


def test_reliability_of_a_flat_depth_is_the_formula() -> None:
    flat = np.full((5, 6), 3.0, np.float32)
    u = reliability(flat, np.full((5, 6), 0.6, np.float32))
    np.testing.assert_allclose(u, 0.6**0.8, rtol=1e-6)
    assert reliability(flat, np.ones((5, 6), np.float32)).min() == 1


def test_an_edge_costs_reliability_on_both_sides_and_a_slope_does_not() -> None:
    edge = np.ones((6, 10), np.float32)
    edge[:, 5:] = np.exp(2 * EDGE_STEP)
    u = reliability(edge, np.ones_like(edge))
    np.testing.assert_allclose(u[:, 4:6], np.exp(-0.7 * 4), rtol=1e-4)
    assert (u[:, [0, 1, 2, 8, 9]] == 1).all()
    slope = np.exp(0.01 * np.arange(10, dtype=np.float32))[None].repeat(6, 0)
    assert reliability(slope, np.ones_like(slope)).min() > 0.99


def test_unknown_depth_has_no_reliability_and_harms_no_neighbour() -> None:
    depth = np.full((6, 6), 2.0, np.float32)
    depth[2, 3] = 0
    u = reliability(depth, np.ones_like(depth))
    assert u[2, 3] == 0
    assert (np.delete(u.ravel(), 2 * 6 + 3) == 1).all()


def test_compact_maps_lose_only_what_they_may() -> None:
    labels = RNG.integers(0, 5, DEPTH.shape).astype(np.uint8)
    maps = ProxyMaps(np.where(CONFIDENCE > 0.1, DEPTH, 0).astype(np.float32), CONFIDENCE, labels, CONFIDENCE)
    small = compact(maps)
    np.testing.assert_array_equal(small.labels, labels)
    np.testing.assert_array_equal(small.depth > 0, maps.depth > 0)
    error = np.abs(small.depth / np.where(maps.depth > 0, maps.depth, 1) - 1) * (maps.depth > 0)
    assert 0 < error[CONFIDENCE > 0.36].max() < 5.1e-4
    assert error.max() < 4.1e-3
    assert 0 < np.abs(small.confidence - CONFIDENCE)[maps.depth > 0].max() < 0.0162
    assert not small.confidence[maps.depth == 0].any()
    np.testing.assert_array_equal(compact(small).depth, small.depth)


def test_mean_iou_of_known_pictures() -> None:
    first = np.array([[0, 0, 1, 1]], np.uint8)
    second = np.array([[0, 1, 1, VOID]], np.uint8)
    # Known in both: three pixels; class 0: 1 of 2, class 1: 1 of 2.
    others = np.stack([second, first, np.full_like(first, VOID)])
    assert mean_iou(first, others) == pytest.approx([0.5, 1, 0])
    assert mean_iou(np.full_like(first, VOID), others).tolist() == [0, 0, 0]
    assert mean_iou(first, others[:0]).shape == (0,)


def test_no_number_that_is_none_reaches_a_file() -> None:
    depth = np.array([[np.nan, np.inf, -1, 0, 3.4e38, 1e-42, 2, 2]], np.float32)
    u = np.array([[0.5, 0.5, 0.5, 0.5, 0.5, 0.5, np.nan, 0.5]], np.float32)
    small = compact(ProxyMaps(depth, u, np.zeros((1, 8), np.uint8), np.full((1, 8), np.nan, np.float32)))
    for values in (small.depth, small.confidence, small.label_confidence):
        assert np.isfinite(values).all()
        assert values.min() >= 0
    np.testing.assert_array_equal(small.depth[0, -2:], 2)
    np.testing.assert_array_equal(small.confidence > 0, [[False] * 4 + [small.depth[0, 4] > 0] + [False] * 2 + [True]])
