"""Mesh errors of shapes whose distance is known."""

import numpy as np
import pytest
import trimesh

from msgs_slam.pipelines.evaluation.mesh_error import (
    depth_points,
    sample_surface,
    seen_in_depth,
    surface_error,
    thinned,
)
from msgs_slam.pipelines.types import Intrinsics


def test_samples_lie_on_the_surface_and_spread_by_area() -> None:
    mesh = trimesh.creation.box((1.0, 2.0, 4.0))
    points = sample_surface(mesh.vertices, mesh.faces, 20000)
    np.testing.assert_allclose(np.abs(points / (0.5, 1, 2)).max(axis=1), 1, atol=1e-12)
    on_top = np.abs(np.abs(points[:, 2]) - 2) < 1e-9
    assert on_top.mean() == pytest.approx(2 * 2 / mesh.area, abs=0.003)
    with pytest.raises(ValueError, match="no area"):
        sample_surface(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10)


def test_a_grown_sphere_is_off_by_its_growth() -> None:
    small, large = (trimesh.creation.icosphere(5, r) for r in (1.0, 1.03))
    a, b = (sample_surface(m.vertices, m.faces, 40000) for m in (small, large))
    found = surface_error(b, a, threshold=0.05)
    assert found.accuracy == pytest.approx(0.03, rel=0.1)
    assert found.completeness == pytest.approx(0.03, rel=0.1)
    assert found.f_score == pytest.approx(1, abs=1e-3)
    assert surface_error(b, a, threshold=0.02).f_score == 0


def test_a_missing_half_costs_completeness_alone() -> None:
    mesh = trimesh.creation.box((2.0, 2.0, 2.0))
    truth = sample_surface(mesh.vertices, mesh.faces, 60000)
    half = truth[truth[:, 0] > 0]
    found = surface_error(half, truth)
    assert found.accuracy == 0
    assert found.precision == 1
    assert found.recall == pytest.approx(0.5, abs=0.05)
    # The far face is 1 m from the cut, the four sides half that on average: (4 x 2 x 0.5 + 4 x 1.2) / 24 roughly.
    assert 0.3 < found.completeness < 0.5
    with pytest.raises(ValueError, match="nothing to compare"):
        surface_error(half, truth[:0])


def test_depth_gives_points_where_they_are_and_tells_what_is_seen() -> None:
    camera = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
    depth = np.full((30, 40), 2.0)
    depth[:, :10] = 0
    pose = np.eye(4)
    pose[:3, 3] = (1, 0, 0)
    points = depth_points(depth, camera, pose)
    assert len(points) == 30 * 30
    np.testing.assert_allclose(points[:, 2], 2)
    np.testing.assert_allclose(points[0], [1 + (10.5 - 20) / 50 * 2, (0.5 - 15) / 50 * 2, 2])
    probes = points[[465, 465, 465]] + np.array([[0, 0, -0.5], [0, 0, 0.01], [0, 0, 0.5]])
    outside = np.array([[9.0, 0, 2], [1.0, 0, -2]])
    seen = seen_in_depth(np.concatenate([probes, outside]), depth, camera, np.linalg.inv(pose), 0.05)
    assert seen.tolist() == [True, True, False, False, False]
    assert len(thinned(np.repeat(points, 3, axis=0), 1e-6)) == len(points)
