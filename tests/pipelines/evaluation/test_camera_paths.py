"""Paths for videos of the map: rigid, smooth, round what the cameras look at."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.scene.upright import cameras_up
from msgs_slam.pipelines.viewer.render_run import orbit, resampled, smoothed
from tests.world import make_world, walk


@pytest.fixture(scope="module")
def room_walk() -> NDArray:
    return walk(make_world(texel=0.2), np.linspace(0, 0.6, 40))


def require_rigid(path: NDArray) -> None:
    products = path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(path[:, :3, :3]), 1, atol=1e-9)


def test_resampling_keeps_the_given_poses_and_goes_between(room_walk: NDArray) -> None:
    dense = resampled(room_walk, 79)
    require_rigid(dense)
    np.testing.assert_allclose(dense[::2], room_walk, atol=1e-9)
    middle = (room_walk[0, :3, 3] + room_walk[1, :3, 3]) / 2
    np.testing.assert_allclose(dense[1, :3, 3], middle, atol=1e-12)
    assert resampled(room_walk[:1], 5).shape == (5, 4, 4)


def test_smoothing_takes_tremble_out_and_leaves_the_walk(room_walk: NDArray) -> None:
    rng = np.random.default_rng(0)
    shaken = room_walk.copy()
    shaken[:, :3, 3] += rng.normal(scale=0.02, size=(40, 3))
    shaken[:, :3, :3] = shaken[:, :3, :3] @ Rotation.from_rotvec(rng.normal(scale=0.02, size=(40, 3))).as_matrix()
    calm = smoothed(shaken, 2.0)
    require_rigid(calm)

    def roughness(path: NDArray) -> float:
        return float(np.abs(np.diff(path[:, :3], n=2, axis=0)).mean())

    assert roughness(calm) < 0.3 * roughness(shaken)
    inner = np.linalg.norm(calm[5:-5, :3, 3] - room_walk[5:-5, :3, 3], axis=1)
    assert 0 < inner.max() < 0.1


def test_an_orbit_goes_round_what_the_cameras_look_at() -> None:
    room_walk = walk(make_world(texel=0.2), np.linspace(0, 0.9, 40))
    path = orbit(room_walk, 2.5, 36, cameras_up(room_walk))
    require_rigid(path)
    centers = path[:, :3, 3]
    # The walk goes round a table in the middle of the room.
    np.testing.assert_allclose(centers.mean(axis=0)[:2], 0, atol=0.35)
    assert np.ptp(centers[:, 2]) < 0.15
    radius = np.linalg.norm(centers[:, :2] - centers.mean(axis=0)[:2], axis=1)
    assert 1.2 < radius.min() < radius.max() < 2.2
    towards = centers.mean(axis=0) - centers
    towards[:, 2] = 0
    assert ((path[:, :3, 2] * towards).sum(axis=1) / np.linalg.norm(towards, axis=1) > 0.8).all()
    assert (path[:, 2, 1] < 0).all()  # the camera's y axis points down


def ring(degrees: NDArray) -> NDArray:
    """Cameras around the origin, 2 away and looking at it; z is up."""
    poses = np.tile(np.eye(4), (len(degrees), 1, 1))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    zero, one = np.zeros_like(c), np.ones_like(c)
    axes = ((-s, c, zero), (zero, zero, -one), (-c, -s, zero))
    poses[:, :3, :3] = np.stack([np.stack(axis, axis=1) for axis in axes], axis=2)
    poses[:, :2, 3] = 2 * np.stack([c, s], axis=1)
    return poses


@pytest.mark.parametrize(("first", "last"), [(150, 230), (-40, 60), (0, 350)])
def test_an_orbit_stays_where_the_cameras_looked_from(first: int, last: int) -> None:
    path = orbit(ring(np.linspace(first, last, 30)), 2.0, 60, np.array([0.0, 0, 1]))
    require_rigid(path)
    np.testing.assert_allclose(np.linalg.norm(path[:, :3, 3], axis=1), 2, atol=1e-6)
    middle = np.radians((first + last) / 2)
    angle = np.degrees(np.angle(np.exp(1j * (np.arctan2(path[:, 1, 3], path[:, 0, 3]) - middle))))
    step = np.abs(np.diff(np.unwrap(np.radians(angle)), append=np.radians(angle[0])))
    if last - first == 350:
        assert np.ptp(angle) > 350
    else:
        np.testing.assert_allclose([angle.min(), angle.max()], [(first - last) / 2, (last - first) / 2], atol=0.5)
        assert step.max() < np.radians(8)  # back again, without a jump


def test_cameras_that_look_apart_still_have_an_orbit() -> None:
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 10)  # side by side, parallel: no common point
    path = orbit(poses, 3.0, 12, cameras_up(poses))
    require_rigid(path)
    assert np.isfinite(path).all()
    np.testing.assert_allclose(path[:, 2, 3], 0, atol=0.1)  # where they stood, and as they looked
    assert (path[:, 2, 2] > 0.95).all()
