"""Bundle adjustment: right derivatives, the same minimum as Ceres, and metres from proxy depths."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.alignment import align_points
from msgs_slam.pipelines.structure import bundle_kernels as kernels
from msgs_slam.pipelines.structure.bundle import Bundle, Problem, adjust_bundle, adjust_pose
from msgs_slam.pipelines.tracking.pnp import colmap_camera
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.tracking.conftest import KnownBundle


def without_depth(bundle: Bundle) -> Bundle:
    return replace(bundle, obs_depth=np.zeros(len(bundle.obs_cam)))


def centres(poses: np.ndarray) -> np.ndarray:
    return se3.inverse(poses)[:, :3, 3]


def aligned_error(poses: np.ndarray, truth: np.ndarray, scale: bool) -> float:
    found, wanted = centres(poses), centres(truth)
    moved = align_points(found, wanted, with_scale=scale).apply(found)
    return float(np.sqrt(((moved - wanted) ** 2).sum(1).mean()))


def test_gradient_agrees_with_differences_of_the_cost(known_bundle: KnownBundle) -> None:
    b = known_bundle.bundle
    camera = np.array([500.0, 500, 320, 240])
    data = (
        camera, b.obs_cam, b.obs_point, b.obs_xy, 1 / b.obs_sd, np.log(b.obs_depth), 1 / b.obs_depth_sd, 2.0
    )  # fmt: skip
    _, cam_right, _, point_right = kernels.linearise(b.cam_from_world, b.points, *data)
    for c, k in ((0, 0), (3, 2), (7, 3), (11, 5), (5, 4)):
        step = np.zeros((12, 6))
        step[c, k] = 1e-6
        up = kernels.total_cost(se3.exp(step) @ b.cam_from_world, b.points, *data)
        down = kernels.total_cost(se3.exp(-step) @ b.cam_from_world, b.points, *data)
        assert -2 * cam_right[c, k] == pytest.approx((up - down) / 2e-6, rel=1e-4)
    for p, k in ((0, 0), (40, 1), (149, 2)):
        step = np.zeros((150, 3))
        step[p, k] = 1e-6
        up = kernels.total_cost(b.cam_from_world, b.points + step, *data)
        down = kernels.total_cost(b.cam_from_world, b.points - step, *data)
        assert -2 * point_right[p, k] == pytest.approx((up - down) / 2e-6, rel=1e-4)


def test_what_a_picture_sees_twice_counts_as_what_it_sees_once_but_surer(known_bundle: KnownBundle) -> None:
    once, quadratic = without_depth(known_bundle.bundle), 1e6
    here = once.obs_cam == 3
    twice = once.select(np.concatenate([np.arange(len(here)), np.flatnonzero(here)]))
    surer = replace(once, obs_sd=once.obs_sd / np.where(here, np.sqrt(2), 1))
    at, steps = (once.cam_from_world, once.points), []
    for bundle in (twice, surer):
        problem = Problem(bundle, known_bundle.intrinsics, quadratic)
        steps.append(problem.solve(at, problem.linearise(*at), 1e-4))
    for found, wanted in zip(*steps, strict=True):
        assert np.abs(wanted).max() > 1e-3
        np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_recovers_poses_and_scale_only_with_depth(known_bundle: KnownBundle) -> None:
    start = known_bundle.bundle
    larger = replace(start, points=start.points * 1.2, cam_from_world=start.cam_from_world.copy())
    larger.cam_from_world[:, :3, 3] *= 1.2
    truth = known_bundle.cam_from_world
    with_depth = adjust_bundle(larger, known_bundle.intrinsics, 50).bundle
    free = adjust_bundle(without_depth(larger), known_bundle.intrinsics, 50).bundle
    assert 0 < aligned_error(with_depth.cam_from_world, truth, scale=False) < 0.01
    assert 0 < aligned_error(free.cam_from_world, truth, scale=True) < 0.01
    assert aligned_error(free.cam_from_world, truth, scale=False) > 0.05
    assert 0.4 < np.sqrt((with_depth.reprojection_errors(known_bundle.intrinsics) ** 2).mean() / 2) < 0.6


def test_outliers_hardly_matter(known_bundle: KnownBundle) -> None:
    rng = np.random.default_rng(1)
    bundle = known_bundle.bundle
    xy = bundle.obs_xy.copy()
    wrong = rng.random(len(xy)) < 0.15
    xy[wrong] += rng.normal(size=(int(wrong.sum()), 2)) * 40
    result = adjust_bundle(replace(bundle, obs_xy=xy), known_bundle.intrinsics, 50)
    assert 0 < aligned_error(result.bundle.cam_from_world, known_bundle.cam_from_world, scale=False) < 0.015


def test_sparse_and_dense_solve_the_same_system(known_bundle: KnownBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    dense = adjust_bundle(known_bundle.bundle, known_bundle.intrinsics, 4).bundle
    monkeypatch.setattr("msgs_slam.pipelines.structure.bundle.DENSE_CAMERAS", 1)
    sparse = adjust_bundle(known_bundle.bundle, known_bundle.intrinsics, 4).bundle
    assert not np.array_equal(dense.points, sparse.points)
    assert np.allclose(dense.cam_from_world, sparse.cam_from_world, atol=1e-7)
    assert np.allclose(dense.points, sparse.points, atol=1e-7)


def test_same_input_same_bytes_and_any_order(known_bundle: KnownBundle) -> None:
    once = adjust_bundle(known_bundle.bundle, known_bundle.intrinsics).bundle
    again = adjust_bundle(known_bundle.bundle, known_bundle.intrinsics).bundle
    assert once.cam_from_world.tobytes() == again.cam_from_world.tobytes()
    order = np.random.default_rng(2).permutation(len(once.obs_cam))
    shuffled = adjust_bundle(known_bundle.bundle.select(order), known_bundle.intrinsics).bundle
    assert shuffled.points.tobytes() == once.points.tobytes()


def test_reaches_the_minimum_of_ceres(known_bundle: KnownBundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.structure.bundle._LEAST_GAIN", 1e-12)
    bundle, intrinsics = without_depth(known_bundle.bundle), known_bundle.intrinsics
    ours = adjust_bundle(bundle, intrinsics, 100, width=1e6)
    reconstruction = to_colmap(bundle, intrinsics)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_principal_point=False, refine_extra_params=False, print_summary=False
    )
    pycolmap.bundle_adjustment(reconstruction, options)
    theirs = np.array([reconstruction.images[c + 1].cam_from_world().matrix() for c in range(12)])
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3] = theirs
    points = np.array([reconstruction.points3D[p].xyz for p in sorted(reconstruction.points3D)])
    in_cam = np.einsum("oij,oj->oi", poses[bundle.obs_cam, :3, :3], points[bundle.obs_point])
    xy = (in_cam + poses[bundle.obs_cam, :3, 3]) @ intrinsics.matrix.T
    ceres_cost = (((xy[:, :2] / xy[:, 2:] - bundle.obs_xy) / 0.5) ** 2).sum()
    assert ours.cost == pytest.approx(ceres_cost, rel=1e-4)


def to_colmap(bundle: Bundle, intrinsics: Intrinsics) -> pycolmap.Reconstruction:
    reconstruction = pycolmap.Reconstruction()
    camera = colmap_camera(intrinsics)
    camera.camera_id = 1
    reconstruction.add_camera_with_trivial_rig(camera)
    for c, pose in enumerate(bundle.cam_from_world):
        mine = np.flatnonzero(bundle.obs_cam == c)
        image = pycolmap.Image(name=str(c), keypoints=bundle.obs_xy[mine], camera_id=1, image_id=c + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    for p, xyz in enumerate(bundle.points):
        track = pycolmap.Track()
        for c in range(len(bundle.cam_from_world)):
            track.add_element(c + 1, p)
        reconstruction.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return reconstruction


def test_motion_only_adjustment_finds_the_pose(known_bundle: KnownBundle) -> None:
    b, truth = known_bundle.bundle, known_bundle.cam_from_world[4]
    mine = b.obs_cam == 4
    start = se3.exp(np.array([0.1, -0.1, 0.05, 0.02, -0.02, 0.01])) @ truth
    found = adjust_pose(
        start, known_bundle.points[b.obs_point[mine]], b.obs_xy[mine], b.obs_sd[mine], known_bundle.intrinsics
    )
    twist = se3.log(found @ se3.inverse(truth))
    assert 0 < np.linalg.norm(twist[:3]) < 0.01
    assert 0 < np.linalg.norm(twist[3:]) < 0.002
