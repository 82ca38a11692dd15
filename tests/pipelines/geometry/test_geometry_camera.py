"""Projection; voxels looked up in blocks; rooms of which nothing or next to nothing was seen."""

import cv2
import numpy as np
import pytest
import torch

from msgs_slam.pipelines.geometry import voxels
from msgs_slam.pipelines.geometry.camera import pixel_centers, project, project_gaussians, unproject, unproject_depth
from msgs_slam.pipelines.geometry.voxels import CEILING, OTHER, Gravity, find_gravity, floor_plane, name_structure
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(64, 48, 51.0, 53.0, 31.3, 25.2)


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-2, -2, 0.3], [2, 2, 7], (100, 3))


def test_projection_agrees_with_opencv_half_a_pixel_aside():
    xy, depth = project(points(), CAMERA)
    matrix = CAMERA.matrix.copy()
    matrix[:2, 2] -= 0.5  # OpenCV's first pixel has its centre at (0, 0)
    expected, _ = cv2.projectPoints(points(), np.zeros(3), np.zeros(3), matrix, None)
    np.testing.assert_allclose(xy, expected[:, 0] + 0.5, atol=1e-9)
    np.testing.assert_array_equal(depth, points()[:, 2])


def test_unproject_inverts_project():
    xy, depth = project(points(), CAMERA)
    np.testing.assert_allclose(unproject(xy, depth, CAMERA), points(), atol=1e-12)


def test_points_not_in_front_have_no_pixel():
    xy, depth = project(np.array([[0.0, 0, 0], [1, 1, -2]]), CAMERA)
    assert np.isnan(xy).all()
    np.testing.assert_array_equal(depth, [0, -2])


def test_a_depth_image_projects_onto_its_own_pixels():
    depth = np.random.default_rng(1).uniform(1, 3, (48, 64))
    xy, z = project(unproject_depth(depth, CAMERA), CAMERA)
    np.testing.assert_allclose(xy, pixel_centers(64, 48), atol=1e-11)
    np.testing.assert_allclose(z, depth)
    assert pixel_centers(64, 48)[0, 0].tolist() == [0.5, 0.5]
    assert pixel_centers(64, 48)[47, 63].tolist() == [63.5, 47.5]


def test_gaussians_project_like_points_and_shrink_with_depth():
    p = torch.from_numpy(points())
    radii = torch.full((100,), 0.1, dtype=torch.float64)
    u, v, sigma, z = project_gaussians(p, radii, CAMERA, near=0.01)
    xy, depth = project(points(), CAMERA)
    np.testing.assert_allclose(torch.stack([u, v], 1).numpy(), xy, atol=1e-10)
    np.testing.assert_allclose(sigma.numpy(), np.sqrt(51.0 * 53.0) * 0.1 / depth)
    np.testing.assert_array_equal(z.numpy(), depth)


def test_gradients_stay_finite_at_and_behind_the_camera():
    p = torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, -1.0], [0.1, 0.2, 1.0]], requires_grad=True)
    u, v, sigma, _ = project_gaussians(p, torch.full((3,), 0.1), CAMERA, near=0.01)
    (u + v + sigma).sum().backward()
    assert torch.isfinite(p.grad).all()
    assert p.grad[2, 2] != 0


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
    np.testing.assert_array_equal(voxels.find_near(there, np.repeat(asked, 3, axis=1)), np.repeat(expected, 3, axis=1))
    if missing > 1:
        outside = voxels.cells_of(asked.ravel()[8:]).min(1) < -1  # touches nothing
        assert outside.any()
        assert (found.ravel()[8:][outside] == -1).all()
        assert (found.ravel()[8:] >= 0).sum() > voxels._BLOCK // 27


@pytest.mark.parametrize(("walls", "within"), [(2, 2.0), (1, 12.0)])
def test_where_no_floor_is_seen_walls_say_what_is_up(walls: int, within: float) -> None:
    """Cameras that look down by 25 degrees; one wall leaves open how far they lean along it."""
    normals = np.eye(3)[[0, 2]][:walls]
    points = np.arange(600.0).reshape(200, 3)
    normal = np.repeat(normals, 200 // walls, axis=0) + 0.05 * np.random.default_rng(0).normal(size=(200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    columns = np.hstack([np.ones((200, 1)), points, normal, points])
    room = voxels.merge(1.0, [(voxels.voxel_keys(points, 1.0), columns)])
    leaning = np.array([np.sin(0.3), np.cos(0.44), np.sin(0.3 if walls == 2 else 0.1)])
    found = find_gravity(room, leaning)
    assert not found.is_sure
    assert 0 < np.degrees(np.arccos(found.up[1])) < within


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("slant", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
@pytest.mark.parametrize("cam_up", [(0.0, 2.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_room_of_next_to_no_surface_has_an_up_and_no_floor(
    count: int, slant: tuple[float, ...], cam_up: tuple[float, ...]
) -> None:
    """Level or upright surface, and cameras whose upward axes cancel out."""
    points = np.arange(3.0 * count).reshape(count, 3)
    frames = [
        (voxels.voxel_keys(points, 1.0), np.hstack([np.ones((count, 1)), points, np.tile(slant, (count, 1)), points]))
    ]
    few, centres = voxels.merge(1.0, frames), np.zeros((2, 3))
    assert len(few) == count
    found = find_gravity(few, np.array(cam_up))
    assert np.isfinite(found.up).all()
    if not count:
        assert not found.is_sure
        np.testing.assert_array_equal(found.up, np.array(cam_up) / max(np.linalg.norm(cam_up), 1))
    for gravity in (found, Gravity(np.array([0.0, 1, 0]), True)):
        kind = name_structure(few, gravity, centres)
        assert len(kind) == count
        assert gravity.is_sure or (kind == OTHER).all()
        assert floor_plane(few, kind, gravity.up) is floor_plane(few, kind, gravity.up, CEILING) is None
