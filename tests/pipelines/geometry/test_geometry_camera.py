"""Projection: against OpenCV, against its own inverse, and for Gaussians against the general formula."""

import cv2
import numpy as np
import torch

from msgs_slam.pipelines.geometry.camera import pixel_centers, project, project_gaussians, unproject, unproject_depth
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
