"""The group of rigid motions: axioms, inverses, and the exponential against scipy's general matrix function."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.geometry import se3

ANGLES = [0.0, 1e-12, 1e-7, 9e-5, 1.1e-4, 1e-2, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-8]


def twists(angle: float, count: int = 20, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([rng.normal(size=(count, 3)), angle * axes], axis=1)


def generator(twist: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = se3.hat(torch.from_numpy(twist[3:])).numpy()
    matrix[:3, 3] = twist[:3]
    return matrix


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_the_matrix_exponential(angle):
    for twist in twists(angle):
        np.testing.assert_allclose(se3.exp(twist), expm(generator(twist)), atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle):
    x = twists(angle)
    np.testing.assert_allclose(se3.log(se3.exp(x)), x, atol=1e-9 if angle < 3.1 else 1e-7)
    np.testing.assert_allclose(se3.rotation_angle(se3.exp(x)), angle, atol=1e-8)


def test_log_of_half_turns_gives_them_back():
    """At exactly π the axis has two signs; either is right."""
    for axis in (np.eye(3), np.array([[0.6, 0.8, 0], [0.6, 0, -0.8], [-1, 1, 1] / np.sqrt(3)])):
        for direction in axis:
            motion = np.eye(4)
            motion[:3, :3] = 2 * np.outer(direction, direction) - np.eye(3)
            np.testing.assert_allclose(se3.exp(se3.log(motion)), motion, atol=1e-12)


def test_log_agrees_with_scipy_on_random_rotations():
    rotations = Rotation.random(500, random_state=1)
    motions = np.tile(np.eye(4), (500, 1, 1))
    motions[:, :3, :3] = rotations.as_matrix()
    np.testing.assert_allclose(se3.log(motions)[:, 3:], rotations.as_rotvec(), atol=1e-9)


def test_group_axioms():
    a, b = se3.exp(twists(1.1, seed=1)), se3.exp(twists(2.3, seed=2))
    np.testing.assert_allclose(se3.inverse(a) @ a, np.tile(np.eye(4), (20, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a), atol=1e-13)


def test_numpy_and_torch_give_the_same_and_their_own_kind():
    x = twists(0.7)
    motion = se3.exp(x)
    assert isinstance(motion, np.ndarray)
    assert motion.dtype == np.float64
    tensor = se3.exp(torch.from_numpy(x).reshape(4, 5, 6))
    assert tensor.shape == (4, 5, 4, 4)
    np.testing.assert_array_equal(tensor.reshape(20, 4, 4).numpy(), motion)
    assert se3.exp(torch.from_numpy(x).float()).dtype == torch.float32


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 3.0])
def test_gradients(angle):
    x = torch.from_numpy(twists(angle, count=2)).requires_grad_()
    assert torch.autograd.gradcheck(se3.exp, (x,), eps=1e-6, atol=1e-7)
    assert torch.autograd.gradcheck(lambda t: se3.log(se3.exp(t)), (x,), eps=1e-6, atol=1e-6)


def test_transform_moves_points():
    motion = se3.exp(twists(0.7)[0])
    points = np.random.default_rng(0).normal(size=(7, 3))
    expected = (motion @ np.concatenate([points, np.ones((7, 1))], 1).T).T[:, :3]
    np.testing.assert_allclose(se3.transform(motion, points), expected, atol=1e-14)
