"""Depth L1 of known disturbances."""

import numpy as np
import pytest

from msgs_slam.pipelines.evaluation.image_quality import DepthErrorSum


def test_scale_noise_and_holes_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    errors = DepthErrorSum()
    for _ in range(3):
        truth = rng.uniform(1, 5, (120, 160)).astype(np.float32)
        truth[:12] = 0
        depth = (0.8 * (truth + rng.normal(scale=0.03, size=truth.shape))).astype(np.float32)
        depth[:, :40] = 0
        errors.add(depth, truth)
    result = errors.result()
    assert result is not None
    assert result.scale == pytest.approx(1.25, rel=2e-3)
    assert result.metric_l1 == pytest.approx(0.2 * 3, rel=0.02)
    # The mean of |normal| is sqrt(2 / pi) standard deviations.
    assert result.scaled_l1 == pytest.approx(0.03 * np.sqrt(2 / np.pi), rel=0.03)
    assert result.valid_fraction == pytest.approx(0.75)


def test_equal_depth_has_no_error_and_no_overlap_no_result() -> None:
    truth = np.linspace(1, 2, 64, dtype=np.float32).reshape(8, 8)
    errors = DepthErrorSum()
    errors.add(truth, truth)
    result = errors.result()
    assert result is not None
    assert (result.metric_l1, result.scaled_l1, result.valid_fraction) == (0, 0, 1)
    empty = DepthErrorSum()
    empty.add(np.zeros_like(truth), truth)
    assert empty.result() is None
