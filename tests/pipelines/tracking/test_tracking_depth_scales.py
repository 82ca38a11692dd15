"""Scale fields and the world's scale are recovered, with honest uncertainty."""

import numpy as np
import pytest

from pipelines.tracking import depth_scales
from pipelines.types import Intrinsics, ProxyMaps

CAMERA = Intrinsics(640, 480, 500, 500, 320, 240)


def test_weighted_median_counts_weights() -> None:
    assert depth_scales.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 1.0])) == 2.0
    assert depth_scales.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([5.0, 1.0, 1.0])) == 3.0


def test_basis_sums_to_one_and_meets_the_corners() -> None:
    rng = np.random.default_rng(0)
    basis = depth_scales.bilinear_basis(rng.uniform(0, 1, (50, 2)) * [640, 480], CAMERA)
    assert np.allclose(basis.sum(1), 1)
    assert (basis >= 0).all()
    ends = depth_scales.bilinear_basis(np.array([[0.0, 0.0], [640.0, 480.0]]), CAMERA)
    assert ends[0].argmax() == 0
    assert ends[1].argmax() == 11


def test_field_follows_a_smooth_error_despite_outliers() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 1, (600, 2)) * [640, 480]
    truth = 0.2 + 0.08 * xy[:, 0] / 640 - 0.05 * xy[:, 1] / 480
    values = truth + rng.normal(size=600) * 0.01
    values[:60] += 1.0
    basis = depth_scales.bilinear_basis(xy, CAMERA)
    field = depth_scales.fit_field(basis, values, np.ones(600))
    error = np.abs(basis @ field.ravel() - truth)[60:]
    assert 0 < np.median(error) < 0.006
    flat = np.abs(depth_scales.keyframe_scale(values, np.ones(600)) - truth)[60:]
    assert np.median(error) < 0.4 * np.median(flat)


def test_field_without_points_is_flat() -> None:
    field = depth_scales.fit_field(np.zeros((0, 12)), np.zeros(0), np.zeros(0))
    assert np.array_equal(field, np.zeros((3, 4)))


@pytest.mark.parametrize("correlated", [False, True])
def test_world_scale_is_within_its_stated_uncertainty(correlated: bool) -> None:
    normalised = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noise = rng.normal(size=60) * 0.03
        if correlated:
            for i in range(1, 60):
                noise[i] = 0.9 * noise[i - 1] + np.sqrt(1 - 0.81) * noise[i]
        found = depth_scales.world_scale(np.log(2.5) + noise)
        normalised.append((np.log(found.factor) + np.log(2.5)) / found.relative_sd)
    spread = float(np.std(normalised))
    # One would be perfect; an estimate that ignored the correlation would give 4.
    assert 0.6 < spread < (1.3 if not correlated else 2.5)


def test_sampling_reads_the_pixel_under_the_point() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(3, 4) + 1
    confidence = np.ones_like(depth)
    confidence[0, 0] = 0.05
    maps = ProxyMaps(depth, confidence, np.zeros((3, 4), np.uint8), confidence)
    xy = np.array([[0.5, 0.5], [639.5, 479.5], [170.0, 10.0]])
    found, reliability = depth_scales.sample_proxy(maps, xy, CAMERA)
    assert found.tolist() == [0.0, 12.0, 2.0]
    assert reliability[0] == pytest.approx(0.05)
