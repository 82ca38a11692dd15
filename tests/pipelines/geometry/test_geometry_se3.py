"""Rigid motions: axioms, inverses, exponential against scipy's; alignment recovers a known similarity, nothing else."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points

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


def random_similarity(rng: np.random.Generator) -> Similarity:
    return Similarity(float(rng.uniform(0.2, 5)), Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


@pytest.mark.parametrize("seed", range(5))
def test_recovers_similarity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng)
    source = rng.normal(size=(20, 3))
    found = align_points(source, truth.apply(source))
    assert found.scale == pytest.approx(truth.scale, rel=1e-10)
    assert np.allclose(found.rotation, truth.rotation, atol=1e-10)
    assert np.allclose(found.translation, truth.translation, atol=1e-10)


def test_planar_and_mirrored_points_give_a_rotation() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(30, 3)) * [1, 1, 0]
    found = align_points(source, source * [-1, 1, 1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    cloud = rng.normal(size=(30, 3))
    assert np.linalg.det(align_points(cloud, cloud * [-1, 1, 1]).rotation) == pytest.approx(1)


def test_least_squares_is_not_beaten_by_its_neighbours() -> None:
    rng = np.random.default_rng(2)
    source, target = rng.normal(size=(15, 3)), rng.normal(size=(15, 3))
    best = align_points(source, target)
    cost = np.sum((best.apply(source) - target) ** 2)
    for _ in range(50):
        spin = Rotation.from_rotvec(rng.normal(size=3) * 0.05).as_matrix()
        other = Similarity(
            best.scale * float(np.exp(rng.normal() * 0.05)),
            spin @ best.rotation,
            best.translation + rng.normal(size=3) * 0.05,
        )
        assert np.sum((other.apply(source) - target) ** 2) > cost


def test_without_scale_keeps_lengths() -> None:
    rng = np.random.default_rng(3)
    source = rng.normal(size=(10, 3))
    assert align_points(source, 3 * source, with_scale=False).scale == 1.0


def test_composition_and_inverse() -> None:
    rng = np.random.default_rng(4)
    a, b = random_similarity(rng), random_similarity(rng)
    points = rng.normal(size=(7, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)))
    assert np.allclose(a.inverse().apply(a.apply(points)), points)


def test_poses_keep_their_pictures() -> None:
    """What a camera sees does not change when the world is mapped: depths scale, directions stay."""
    rng = np.random.default_rng(5)
    similarity = random_similarity(rng)
    cam_from_source = np.eye(4)
    cam_from_source[:3, :3], cam_from_source[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    points = rng.normal(size=(9, 3))
    before = points @ cam_from_source[:3, :3].T + cam_from_source[:3, 3]
    cam_from_target = similarity.apply_to_poses(cam_from_source[None])[0]
    after = similarity.apply(points) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    assert np.allclose(after, similarity.scale * before)


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1, 2, 3]), np.full((4, 3), np.nan)])
def test_undetermined_alignment_is_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="alignment"):
        align_points(points, points)
