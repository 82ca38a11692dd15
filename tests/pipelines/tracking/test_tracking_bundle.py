"""Bundle adjustment: right derivatives, the same minimum as Ceres, and metres from proxy depths."""

from collections.abc import Container
from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.adjust import FEATURE_SD
from msgs_slam.pipelines.sfm.bundle import Bundle, Problem, adjust_bundle, adjust_pose, solve_blocks
from msgs_slam.pipelines.sfm.given import posed_model
from msgs_slam.pipelines.tracking import adjust
from msgs_slam.pipelines.tracking.adjust import adjust_state, consistent, part_loose
from msgs_slam.pipelines.tracking.pnp import colmap_camera
from msgs_slam.pipelines.tracking.state import Sightings, TrackState
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.frames.made_views import model_of_bundle, walk_along_bare_wall
from tests.pipelines.frames.test_frames_given import CAMERA
from tests.pipelines.tracking.conftest import KnownBundle


def without_depth(bundle: Bundle) -> Bundle:
    return replace(bundle, obs_depth=np.zeros(len(bundle.obs_cam)))


def centres(poses: np.ndarray) -> np.ndarray:
    return se3.inverse(poses)[:, :3, 3]


def aligned_error(poses: np.ndarray, truth: np.ndarray, scale: bool) -> float:
    found, wanted = centres(poses), centres(truth)
    moved = align_points(found, wanted, with_scale=scale).apply(found)
    return float(np.sqrt(((moved - wanted) ** 2).sum(1).mean()))


def followed(bundle: Bundle) -> Bundle:
    """Of four cameras the first found its points; they were followed into the third, and from there into the others."""
    to_source = np.array([0, 1, -2, -1])[bundle.obs_cam % 4]
    return replace(bundle, obs_source=np.where(bundle.obs_cam % 4 == 0, -1, bundle.obs_cam + to_source))


@pytest.mark.parametrize("alone", [False, True])
def test_gradient_agrees_with_differences_of_the_cost(known_bundle: KnownBundle, alone: bool) -> None:
    b = known_bundle.bundle if alone else followed(known_bundle.bundle)
    problem = Problem(b, known_bundle.intrinsics)
    _, cam_right, _, point_right = problem.linearise(b.cam_from_world, b.points)
    for c, k in ((0, 0), (3, 2), (7, 3), (11, 5), (5, 4)):
        step = np.zeros((12, 6))
        step[c, k] = 1e-6
        up = problem.cost(se3.exp(step) @ b.cam_from_world, b.points)
        down = problem.cost(se3.exp(-step) @ b.cam_from_world, b.points)
        assert -2 * cam_right[c, k] == pytest.approx((up - down) / 2e-6, rel=1e-4)
    for p, k in ((0, 0), (40, 1), (149, 2)):
        step = np.zeros((150, 3))
        step[p, k] = 1e-6
        up = problem.cost(b.cam_from_world, b.points + step)
        down = problem.cost(b.cam_from_world, b.points - step)
        assert -2 * point_right[p, k] == pytest.approx((up - down) / 2e-6, rel=1e-4)


def test_step_is_that_of_the_whole_system_of_normal_equations(known_bundle: KnownBundle) -> None:
    bundle = without_depth(followed(known_bundle.bundle))
    few = bundle.select((bundle.obs_cam < 4) & (bundle.obs_point < 15))
    bundle = replace(few, cam_from_world=few.cam_from_world[:4], points=few.points[:15])
    camera, seen = known_bundle.intrinsics, zip(few.obs_cam, few.obs_point, strict=True)
    row = {(c, p): o for o, (c, p) in enumerate(seen)}
    sources = [row[c, p] if c >= 0 else -1 for c, p in zip(few.obs_source, few.obs_point, strict=True)]

    def residuals(step: np.ndarray) -> np.ndarray:
        motions = se3.exp(step[:24].reshape(4, 6)) @ bundle.cam_from_world
        points = bundle.points + step[24:].reshape(15, 3)
        at = np.einsum("oij,oj->oi", motions[few.obs_cam, :3, :3], points[few.obs_point]) + motions[few.obs_cam, :3, 3]
        off = at[:, :2] / at[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy] - few.obs_xy
        return ((off - [off[s] if s >= 0 else (0, 0) for s in sources]) / few.obs_sd[:, None]).ravel()

    units = np.eye(24 + 45) * 1e-6
    jacobian = np.array([(residuals(u) - residuals(-u)) / 2e-6 for u in units]).T
    normal, damping = jacobian.T @ jacobian, 1e-2
    step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -jacobian.T @ residuals(np.zeros(24 + 45)))
    problem, at = Problem(bundle, camera, width=1e6), (bundle.cam_from_world, bundle.points)
    found = problem.solve(at, problem.linearise(*at), damping)
    assert found is not None
    np.testing.assert_allclose(np.concatenate([found[0].ravel(), found[1].ravel()]), step, rtol=1e-3, atol=1e-6)


def test_error_of_a_feature_that_was_followed_counts_once(known_bundle: KnownBundle) -> None:
    bundle, truth, camera = without_depth(followed(known_bundle.bundle)), known_bundle, known_bundle.intrinsics
    motions, own, rows = truth.cam_from_world[bundle.obs_cam], bundle.obs_source < 0, bundle.source_rows()
    in_cam = np.einsum("oij,oj->oi", motions[:, :3, :3], truth.points[bundle.obs_point]) + motions[:, :3, 3]
    errors = []
    for seed in range(4):
        off = np.where(own[:, None], 1.0, 0.05) * np.random.default_rng(seed).normal(size=bundle.obs_xy.shape)
        for last in (2, 1, 3):
            off += np.where((bundle.obs_cam % 4 == last)[:, None], off[rows], 0.0)
        seen = replace(bundle, obs_xy=project(in_cam, camera)[0] + off, obs_sd=np.where(own, 1.0, 0.05))
        alike = replace(seen, obs_sd=np.ones(len(own)), obs_source=np.full(len(own), -1))
        found = [adjust_bundle(b, camera, 50).bundle.cam_from_world for b in (seen, alike)]
        errors.append([aligned_error(poses, truth.cam_from_world, scale=True) for poses in found])
    once, each_time = np.mean(errors, axis=0)
    assert 0 < once < 0.8 * each_time


def test_what_was_followed_from_an_outlier_goes_with_it_over_all_frames(known_bundle: KnownBundle) -> None:
    bundle = without_depth(followed(known_bundle.bundle))
    off = bundle.obs_xy.copy()
    chain = (bundle.obs_point == 3) & (bundle.obs_cam < 4)
    off[chain] += 60.0  # the feature in camera 0 is wrong; 2 was followed from it, 1 and 3 from there
    keep = consistent(replace(bundle, obs_xy=off), known_bundle.intrinsics, np.ones(len(off), np.bool_))
    assert not keep[chain].any()
    assert keep[~chain].mean() > 0.99


@pytest.mark.parametrize(("together", "share"), [(True, 0.3), (False, 0.7)])
def test_frames_follow_their_keyframes_but_for_the_errors_of_its_features(
    known_bundle: KnownBundle, monkeypatch: pytest.MonkeyPatch, together: bool, share: float
) -> None:
    if not together:
        monkeypatch.setattr("msgs_slam.pipelines.tracking.adjust.MAX_FRAMES", 4)
    truth, points = known_bundle.cam_from_world, known_bundle.points
    errors = []
    for is_known in (True, False):
        state = TrackState(points.copy(), np.zeros((len(points), 3), np.uint8))
        for k, pose in enumerate(truth):
            exact, _ = project(se3.transform(pose, points), known_bundle.intrinsics)
            off = np.random.default_rng(k // 3).normal(size=exact.shape)  # the keyframe's, and of those that follow it
            keyframe, is_keyframe = k - k % 3, k % 3 == 0
            known = (0.5, -1) if is_keyframe or not is_known else (0.05, keyframe)
            seen = Sightings.of(np.arange(len(points)), exact + off, *known)
            state.add_frame(k, pose, seen if is_keyframe else seen.select(slice(None, None, 7)), is_keyframe, segment=0)
        adjust_state(state, known_bundle.intrinsics, lambda _: None, False, True)
        found = np.array([state.poses[i] for i in range(12)])
        after = np.array([1, 2, 4, 5, 7, 8, 10, 11])
        ours, theirs = (p[after] @ se3.inverse(p[after - after % 3]) for p in (found, truth))
        errors.append(float(np.sqrt((se3.rotation_angle(ours @ se3.inverse(theirs)) ** 2).mean())))
    assert 0 < errors[0] < share * errors[1]


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
    monkeypatch.setattr("msgs_slam.pipelines.sfm.bundle.DENSE_CAMERAS", 1)
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
    monkeypatch.setattr("msgs_slam.pipelines.sfm.bundle._MIN_GAIN", 1e-12)
    bundle, intrinsics = without_depth(known_bundle.bundle), known_bundle.intrinsics
    ours = adjust_bundle(bundle, intrinsics, 100, width=1e6)
    camera = colmap_camera(intrinsics)
    camera.camera_id = 1
    reconstruction, _ = model_of_bundle(bundle, camera)
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


@pytest.mark.parametrize("count", [3, 400])
def test_equations_of_a_model_gone_wild_have_no_solution(count: int) -> None:
    blocks, pairs = np.tile(np.eye(6), (count, 1, 1)), np.repeat(np.arange(count)[:, None], 2, axis=1)
    assert solve_blocks(blocks, pairs, np.ones(6 * count)) is not None
    blocks[1, 0, 0] = np.nan
    assert solve_blocks(blocks, pairs, np.ones(6 * count)) is None


def walk_state(views: int, keyframes: Container[int]) -> tuple[TrackState, Intrinsics]:
    """Tracked along a bare wall, of which the first twelve frames show a strip of floor alone."""
    made = walk_along_bare_wall(CAMERA, views)
    state = TrackState(np.zeros((1 + max(int(s.max()) for s in made.seen), 3)))
    model = posed_model(CAMERA, made.views().xy, made.cam_from_world, made.pairs(CAMERA), False, 0)
    assert model is not None
    for point in model.points3D.values():
        of = {int(made.seen[e.image_id - 1][e.point2D_idx]) for e in point.track.elements}
        state.points[sorted(of)] = point.xyz
    known = np.abs(state.points).sum(1) > 0
    for i in range(views):
        seen = Sightings.of(made.seen[i], made.features[i].xy, FEATURE_SD)
        pose = np.vstack([model.images[i + 1].cam_from_world().matrix(), [0, 0, 0, 1]])
        state.add_frame(i, pose, seen.select(known[seen.point]), i in keyframes, 0)
    return state, Intrinsics(640, 480, 520.0, 520.0, 320.0, 240.0)


def test_frames_whose_poses_nothing_determines_are_lost() -> None:
    every = range(34)
    state, intrinsics = walk_state(34, every)
    for i in (15, 20, 21, 33):  # too few of the points to hold, and of the last one nothing is behind
        state.sightings[i] = state.sightings[i].select(np.arange(3))
    report = adjust_state(state, intrinsics, lambda _: None, False, True)
    before = dict(state.poses)
    part_loose(state, report, intrinsics, least=8)
    assert sorted(state.poses) == state.keyframes == list(range(12, 33))
    assert sorted(state.lost) == [*range(12), 33]
    assert all("does not determine its pose" in why for why in state.lost.values())
    assert all(np.array_equal(state.poses[i], before[i]) for i in state.poses)


def test_frames_that_follow_loose_keyframes_are_lost_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjust, "MAX_FRAMES", 10)
    state, intrinsics = walk_state(28, [*range(0, 12, 2), *range(12, 28)])
    report = adjust_state(state, intrinsics, lambda _: None, False, True)
    assert report.frame_ids == [*range(0, 12, 2), *range(12, 28)]
    part_loose(state, report, intrinsics, least=8)
    assert sorted(state.poses) == list(range(12, 28))


def test_exact_depths_determine_what_the_images_do_not() -> None:
    """Without them a half that lies loosely beside the rest is a world of its own."""
    state, intrinsics = walk_state(20, range(20))
    report = adjust_state(state, intrinsics, lambda _: None, False, True)
    z = report.bundle.points_in_cam()[:, 2]
    tied = replace(report, bundle=replace(report.bundle, obs_depth=z, obs_depth_sd=np.full(len(z), 1e-6)))
    part_loose(state, tied, intrinsics, least=8)
    assert sorted(state.poses) == list(range(20))
    assert set(state.segment.values()) == {0}
    part_loose(state, report, intrinsics, least=8)
    assert sorted(state.poses) == list(range(20))
    assert [i for i, segment in state.segment.items() if segment] == list(range(12))
    theirs, ours = (np.concatenate([state.sightings[i].point for i in r]) for r in (range(12), range(12, 20)))
    assert len(theirs) > 0
    assert not np.isin(theirs, ours).any()
