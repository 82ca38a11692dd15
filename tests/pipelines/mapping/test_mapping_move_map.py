"""The map and the frames between follow their keyframes."""

import numpy as np
import torch

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.mapping.move_map import follow_keyframes, move_map
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(320, 240, 300, 300, 160, 120)


def scene() -> tuple[GaussianMap, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    ids = np.array([0, 4, 8])
    poses = se3.exp(rng.normal(size=(3, 6)) * 0.1)
    means = rng.normal(size=(60, 3)) * 0.5 + [0, 0, 3]
    gaussians = GaussianMap(
        torch.tensor(means, dtype=torch.float32), torch.full((60,), -3.0), torch.zeros(60), torch.rand(60, 3),
        torch.zeros(60, 2), torch.tensor(np.repeat([0, 4, 8], 20)),
    )  # fmt: skip
    return gaussians, ids, poses


def pixels(gaussians: GaussianMap, pose: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    means = gaussians.means.double().numpy()[rows]
    return project(means @ pose[:3, :3].T + pose[:3, 3], CAMERA)


def test_gaussians_keep_their_place_in_their_anchors_picture() -> None:
    gaussians, ids, old = scene()
    new = se3.exp(np.random.default_rng(1).normal(size=(3, 6)) * 0.1) @ old
    ratio = np.array([1.0, 1.2, 0.9])
    moved = move_map(gaussians, ids, old, new, ratio)
    for n in range(3):
        rows = slice(20 * n, 20 * n + 20)
        before, z_before = pixels(gaussians, old[n], rows)
        after, z_after = pixels(moved, new[n], rows)
        assert np.abs(before - after).max() < 1e-2
        assert np.allclose(z_after, ratio[n] * z_before, rtol=1e-4)
        # Size in the picture: radius over depth stays.
        assert torch.allclose(moved.radii[rows], gaussians.radii[rows] * float(ratio[n]))


def test_a_rigid_move_of_all_keyframes_moves_the_world() -> None:
    gaussians, ids, old = scene()
    world = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.1]))
    moved = move_map(gaussians, ids, old, old @ se3.inverse(world), np.ones(3))
    wanted = se3.transform(world, gaussians.means.double().numpy())
    assert np.allclose(moved.means.numpy(), wanted, atol=1e-5)
    frames = se3.exp(np.random.default_rng(2).normal(size=(9, 6)) * 0.1)
    frames[[0, 4, 8]] = old
    followed = follow_keyframes(np.arange(9), frames, ids, old, old @ se3.inverse(world), np.ones(3))
    assert np.allclose(followed, frames @ se3.inverse(world), atol=1e-9)


def test_unknown_anchors_follow_the_nearest_keyframe() -> None:
    gaussians, ids, _ = scene()
    shift = np.tile(np.eye(4), (3, 1, 1))
    shift[2, 0, 3] = -1.0
    stray = GaussianMap(
        gaussians.means, gaussians.log_radii, gaussians.opacity_logits, gaussians.colors, gaussians.class_logits,
        torch.full((60,), 7),
    )  # fmt: skip
    moved = move_map(stray, ids, np.tile(np.eye(4), (3, 1, 1)), shift, np.ones(3))
    assert torch.allclose(moved.means[:, 0], gaussians.means[:, 0] + 1, atol=1e-5)


def test_frames_between_take_a_share_of_both_corrections() -> None:
    ids = np.array([0, 4])
    frames = np.tile(np.eye(4), (5, 1, 1))
    new = np.tile(np.eye(4), (2, 1, 1))
    new[1, 0, 3] = 0.4
    followed = follow_keyframes(np.arange(5), frames, ids, frames[[0, 4]], new, np.ones(2))
    assert np.allclose(followed[:, 0, 3], [0, 0.1, 0.2, 0.3, 0.4])
