"""Scale fields and the world's scale are recovered, with honest uncertainty."""

import numpy as np
import pytest

from msgs_slam.pipelines.depth import align as scales
from msgs_slam.pipelines.depth.align import COARSE
from msgs_slam.pipelines.depth.fields import Equations, solve_fields
from msgs_slam.pipelines.types import Intrinsics, ProxyMaps

CAMERA = Intrinsics(640, 480, 500, 500, 320, 240)


def test_weighted_median_counts_weights() -> None:
    assert scales.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 1.0])) == 2.0
    assert scales.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([5.0, 1.0, 1.0])) == 3.0


def test_basis_sums_to_one_and_meets_the_corners() -> None:
    rng = np.random.default_rng(0)
    basis = COARSE.at(rng.uniform(0, 1, (50, 2)) * [640, 480], 640, 480)
    assert np.allclose(basis.weights.sum(1), 1)
    assert (basis.weights >= 0).all()
    nodes = np.arange(12.0)
    assert np.allclose(COARSE.at(np.array([[0.0, 0.0], [640.0, 480.0]]), 640, 480).of(nodes), [0, 11])
    assert np.allclose(basis.of(np.tile(nodes, (50, 1))), basis.of(nodes))


def test_a_finer_grid_holds_the_same_field() -> None:
    slanted = (np.arange(3)[:, None] * 0.1 + np.arange(4) * 0.02).ravel()
    fine = scales.as_fine(slanted).reshape(9, 12)
    assert np.allclose(fine[[0, 0, -1, -1], [0, -1, 0, -1]], slanted[[0, 3, 8, 11]])
    assert np.allclose(np.diff(fine, axis=0), 0.2 / 8)


def test_field_follows_a_smooth_error_despite_outliers() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 1, (600, 2)) * [640, 480]
    truth = 0.2 + 0.08 * xy[:, 0] / 640 - 0.05 * xy[:, 1] / 480
    values = truth + rng.normal(size=600) * 0.01
    values[:60] += 1.0
    basis, one = COARSE.at(xy, 640, 480), np.ones(600)
    middle = scales.keyframe_scale(values, one)
    (field,) = scales.fit_to_points(np.zeros(600, int), basis, values, one, np.array([middle]))
    error = np.abs(basis.of(field) - truth)[60:]
    assert 0 < np.median(error) < 0.006
    assert np.median(error) < 0.4 * np.median(np.abs(middle - truth)[60:])


def test_field_without_points_is_flat() -> None:
    nothing = COARSE.at(np.zeros((0, 2)), 640, 480)
    fields = scales.fit_to_points(np.zeros(0, int), nothing, np.zeros(0), np.zeros(0), np.array([0.0, 0.3]))
    assert np.allclose(fields, [[0.0] * 12, [0.3] * 12])


@pytest.mark.parametrize("broken", [True, False])
def test_a_field_that_does_not_converge_stays_as_it_was_and_that_is_said(
    broken: bool, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    basis = COARSE.at(rng.uniform(0, 1, (40, 2)), 1, 1)
    residual = rng.normal(0, 0.1, 40)
    residual[0] = np.nan if broken else 0.0
    parts = [Equations.of_places(0, basis, COARSE.size, residual, np.full(40, 0.05), 1.0)]
    before = np.full((1, COARSE.size), 0.2)
    after = solve_fields(parts, before, before, scales.POINTS_PRIOR)
    assert np.array_equal(after, before) == broken
    assert np.isfinite(after).all()
    assert ("did not converge" in caplog.text) == broken


def test_sampling_reads_the_pixel_under_the_point() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(3, 4) + 1
    confidence = np.ones_like(depth)
    confidence[0, 0] = 0.05
    maps = ProxyMaps(depth, confidence, np.zeros((3, 4), np.uint8), confidence)
    xy = np.array([[0.5, 0.5], [639.5, 479.5], [170.0, 10.0]])
    found, reliability = scales.sample_proxy(maps, xy, CAMERA)
    assert found.tolist() == [0.0, 12.0, 2.0]
    assert reliability[0] == pytest.approx(0.05)
