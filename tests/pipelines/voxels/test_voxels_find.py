"""Voxels looked up in blocks, against all of them at once."""

import numpy as np
import pytest

from msgs_slam.pipelines.voxels import voxels


@pytest.mark.parametrize("missing", [0, 1, 5_000])
def test_a_missing_voxel_is_answered_by_one_that_touches_it(missing: int) -> None:
    """Also where more are missing than are looked up at once."""
    rng = np.random.default_rng(missing)
    there = np.unique(voxels.voxel_keys(rng.integers(0, 30, (4_000, 3)) + 0.5, 1.0))
    asked = voxels.voxel_keys(rng.integers(-4, 34, (missing + 7, 3)) + 0.5, 1.0).reshape(-1, 1)
    asked[:7, 0] = there[:7]
    asked[7:8] = -1  # too far out to have a voxel
    around = voxels.find(there, voxels.neighbour_keys(asked.ravel()))
    one = np.take_along_axis(around, (around >= 0).argmax(1)[:, None], 1)
    expected = np.where(voxels.find(there, asked) >= 0, voxels.find(there, asked), one)
    expected[asked == -1] = -1
    found = voxels.find_near(there, asked)
    assert found.shape == asked.shape
    np.testing.assert_array_equal(found, expected)
    if missing > 1:
        outside = voxels.cells_of(asked.ravel()[8:]).min(1) < -1  # touches nothing
        assert outside.any()
        assert (found.ravel()[8:][outside] == -1).all()
        assert (found.ravel()[8:] >= 0).sum() > voxels._BLOCK // 27
