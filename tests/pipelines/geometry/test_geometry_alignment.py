"""Alignment recovers a known similarity, and nothing else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.geometry.se3 import Similarity, align_points


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
