"""Gauss-Newton pose fitting: its equations against finite differences, its result against the known pose."""

import numpy as np
import pytest
import torch
from render_scenes import Room, room
from torch import Tensor

from msgs_slam.pipelines.compute.threads import set_threads
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.render.tracking import _Problem, track_gn

TRUE_POSE = torch.eye(4, dtype=torch.float64)


def observation(scene: Room, noise: float = 1.0) -> Tensor:
    """What a camera at the true pose sees, with noise of 0.02."""
    seen = render(scene.means, scene.radii, scene.opacities, scene.colors, TRUE_POSE, scene.intrinsics)
    generator = torch.Generator().manual_seed(3)
    return seen.features + noise * 0.02 * torch.randn(seen.features.shape, generator=generator)


def displaced(distance: float, degrees: float, seed: int) -> Tensor:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return se3.exp(torch.from_numpy(np.concatenate([distance * directions[0], np.radians(degrees) * directions[1]])))


def map_of(scene: Room) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return scene.means, scene.radii, scene.opacities, scene.colors


def error_of(pose: Tensor) -> tuple[float, float]:
    """Distance of the camera's centre from the true one, and angle in degrees."""
    return float(se3.inverse(pose)[:3, 3].norm()), float(torch.rad2deg(se3.rotation_angle(pose)))


@pytest.mark.parametrize("threads", [1, 3])
def test_normal_equations_equal_finite_differences_of_the_reference(threads):
    scene = room(40, 70, 1500, 1)
    image = observation(scene)
    pose, floor = displaced(0.01, 0.3, seed=2), 0.05
    set_threads(threads)
    problem = _Problem(*map_of(scene), scene.intrinsics, image)
    information, gradient, cost, pixels, _ = problem.normal_equations(pose, floor, 0.5)
    set_threads(0)

    exact = [x.double() for x in map_of(scene)]

    def residuals(twist: Tensor) -> Tensor:
        seen = render(*exact, pose, scene.intrinsics, twist=twist, backend="reference")
        return (seen.features - image)[mask]

    mask = render(*exact, pose, scene.intrinsics, backend="reference").silhouette >= 0.5
    # Tiny steps: opacity jumps where a Gaussian ends, and a pixel that crosses the edge would look like a slope.
    steps = 1e-9 * torch.eye(6, dtype=torch.float64)
    jacobian = torch.stack([(residuals(step) - residuals(-step)) / 2e-9 for step in steps], -1)
    residual = residuals(torch.zeros(6, dtype=torch.float64))
    weights = 1 / residual.abs().clamp(min=floor)
    expected = torch.einsum("pcq,pc,pcr->qr", jacobian, weights, jacobian).numpy()
    expected_gradient = torch.einsum("pcq,pc,pc->q", jacobian, weights, residual).numpy()
    assert pixels == int(mask.sum())
    assert cost == pytest.approx(float(residual.abs().sum()), rel=1e-4)
    assert np.abs(information - expected).max() < 1e-3 * np.abs(expected).max()
    assert np.abs(gradient - expected_gradient).max() < 1e-3 * np.abs(expected_gradient).max()


@pytest.mark.parametrize("seed", range(4))
def test_a_centimetre_and_a_third_of_a_degree_take_four_evaluations(seed):
    scene = room(320, 240, 50_000, 1)
    image = observation(scene)
    start = displaced(0.01, 0.3, seed)
    fit = track_gn(*map_of(scene), start, scene.intrinsics, image)
    distance, degrees = error_of(fit.cam_from_world)
    assert fit.converged, fit.reason
    assert fit.evaluations <= 4
    assert 1e-7 < distance < 0.5e-3
    assert degrees < 0.02


def test_same_bytes_for_any_number_of_threads():
    scene = room(160, 120, 8000, 1)
    image = observation(scene)
    poses = []
    for threads in (1, 2, 4):
        set_threads(threads)
        fit = track_gn(*map_of(scene), displaced(0.01, 0.3, 0), scene.intrinsics, image)
        poses.append(fit.cam_from_world.numpy().tobytes())
    set_threads(0)
    assert poses[0] == poses[1] == poses[2]


def test_colour_alone_is_enough():
    scene = room(160, 120, 12000, 1)
    image = observation(scene, noise=0.0)
    fit = track_gn(*map_of(scene), displaced(0.005, 0.2, 1), scene.intrinsics, image, min_silhouette=0.7)
    assert fit.converged, fit.reason
    assert 0 < error_of(fit.cam_from_world)[0] < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_a_start_too_far_away_is_refused_or_right(seed):
    scene = room(160, 120, 12000, 1)
    image = observation(scene)
    start = displaced(0.3, 9.0, seed)
    fit = track_gn(*map_of(scene), start, scene.intrinsics, image, min_silhouette=0.7)
    if fit.converged:
        assert error_of(fit.cam_from_world)[0] < 2e-3
    else:
        assert fit.reason
        assert torch.equal(fit.cam_from_world, start)


def test_a_camera_that_does_not_see_the_map_is_refused():
    scene = room(80, 60, 3000, 1)
    image = observation(scene)
    away = se3.exp(torch.tensor([0, 0, 0, 0, torch.pi, 0], dtype=torch.float64))
    fit = track_gn(*map_of(scene), away, scene.intrinsics, image)
    assert not fit.converged
    assert "pixels show the map" in fit.reason
    assert fit.evaluations == 1


def test_an_image_without_texture_is_refused():
    """One colour: nothing fixes the pose."""
    scene = room(80, 60, 3000, 1)
    grey = torch.full_like(scene.colors, 0.5)
    solid = torch.full_like(scene.opacities, 1.0)
    image = torch.full((60, 80, 3), 0.5)
    fit = track_gn(scene.means, 3 * scene.radii, solid, grey, TRUE_POSE, scene.intrinsics, image, min_silhouette=0.999)
    assert not fit.converged or error_of(fit.cam_from_world)[0] < 1e-3


def test_arguments_are_checked():
    scene = room(40, 30, 100, 1)
    image = observation(scene)
    image[3, 4, 1] = torch.nan
    with pytest.raises(ValueError, match=r"^image: 1 of"):
        track_gn(*map_of(scene), TRUE_POSE, scene.intrinsics, image)
    with pytest.raises(ValueError, match="image: got shape"):
        track_gn(*map_of(scene), TRUE_POSE, scene.intrinsics, torch.zeros(5, 40, 3))
