"""Flow, prediction, PnP and the state they fill; a lost frame is found again, unless two places explain it as well."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project, unproject
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.sfm.features import sift_features
from msgs_slam.pipelines.sfm.flow import find_corners, follow
from msgs_slam.pipelines.sfm.matching import match_descriptors
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.tracking.front_end import triangulate
from msgs_slam.pipelines.tracking.links import agree
from msgs_slam.pipelines.tracking.pnp import interpolate_pose, predict_pose, relocalise, solve_pose
from msgs_slam.pipelines.tracking.state import NO_SIGHTINGS, Sightings, TrackState
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.tracking.conftest import KnownBundle


def texture(seed: int, shape: tuple[int, int] = (200, 260)) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 300 * smooth, 0, 255).astype(np.uint8)


def test_flow_measures_a_subpixel_shift() -> None:
    first = texture(0)
    shift = np.array([3.3, -2.6])
    moved = cv2.warpAffine(first, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (260, 200), flags=cv2.INTER_CUBIC)
    xy = find_corners(first, np.zeros((0, 2)), 60)
    inner = (np.abs(xy - [130, 100]) < [100, 70]).all(1)
    there, found = follow(first, moved, xy[inner], xy[inner].copy())
    error = np.linalg.norm(there[found] - xy[inner][found] - shift, axis=1)
    assert found.mean() > 0.9
    assert 0 < np.median(error) < 0.1


def test_flow_refuses_what_is_not_there() -> None:
    xy = find_corners(texture(0), np.zeros((0, 2)), 60)
    _, found = follow(texture(0), texture(1), xy, xy.copy())
    assert found.mean() < 0.2
    _, found = follow(texture(0), texture(0), xy, np.full_like(xy, np.nan))
    assert not found.any()


def test_corners_keep_their_distance() -> None:
    taken = np.array([[50.0, 50.0], [100.0, 80.0]])
    xy = find_corners(texture(2), taken, 100, distance=12)
    assert len(xy) > 20
    assert np.linalg.norm(xy[:, None] - taken, axis=2).min() > 9


def test_triangulation_measures_depth_and_refuses_parallel_rays() -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(640, 480, 500, 500, 320, 240)
    points = rng.uniform([-1, -1, 3], [1, 1, 6], (40, 3))
    points[30:, 2] *= 100
    motion = se3.exp(np.array([-0.3, 0.02, 0.05, 0.02, 0.05, 0.0]))
    xy1, _ = project(points, camera)
    xy2, _ = project(se3.transform(motion, points), camera)
    xy2[:5, 1] += 20
    found, good = triangulate(xy1, xy2, motion, camera, 2.0)
    assert good[5:30].all()
    assert not good[:5].any()
    assert not good[30:].any()
    assert np.allclose(found[5:30], points[5:30], atol=1e-6)


def test_prediction_follows_a_steady_screw() -> None:
    twist = np.array([0.1, 0.02, 0, 0, 0.05, 0.01])
    poses = {i: se3.exp(twist * i) for i in range(3)}
    times = {i: 0.1 * i for i in range(10)}
    assert np.allclose(predict_pose(3, poses, times), se3.exp(twist * 3))
    uneven = {**times, 3: 0.25}
    assert np.allclose(predict_pose(3, poses, uneven), se3.exp(twist * 2.5))
    inside = {0: poses[0], 2: poses[2]}
    assert np.allclose(predict_pose(1, inside, times), se3.exp(twist))
    assert np.array_equal(predict_pose(9, poses, times), poses[2])
    assert predict_pose(0, {}, times) is None
    assert np.allclose(interpolate_pose(poses[0], poses[2], 0.5), poses[1])


def test_pose_from_points_survives_outliers_and_repeats(known_bundle: KnownBundle) -> None:
    rng = np.random.default_rng(0)
    truth, points, camera = known_bundle.cam_from_world[2], known_bundle.points, known_bundle.intrinsics
    xy, _ = project(points @ truth[:3, :3].T + truth[:3, 3], camera)
    xy = xy + rng.normal(size=xy.shape) * 0.3
    wrong = np.arange(len(xy)) < 60
    xy[wrong] = rng.uniform(0, 1, (60, 2)) * [640, 480]
    solved = solve_pose(xy, points, camera, seed=1)
    assert solved is not None
    assert solved.inliers[~wrong].mean() > 0.97
    assert solved.inliers[wrong].mean() < 0.05
    assert 0 < np.linalg.norm(se3.log(solved.cam_from_world @ se3.inverse(truth))) < 0.01
    again = solve_pose(xy, points, camera, seed=1)
    assert again is not None
    assert again.cam_from_world.tobytes() == solved.cam_from_world.tobytes()


def test_an_expected_pose_that_explains_nearly_all_points_is_not_sought_again(
    known_bundle: KnownBundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, estimate = [], pycolmap.estimate_absolute_pose
    monkeypatch.setattr(pycolmap, "estimate_absolute_pose", lambda *a: asked.append(len(a[0])) or estimate(*a))
    rng = np.random.default_rng(0)
    truth, points, camera = known_bundle.cam_from_world[2], known_bundle.points, known_bundle.intrinsics
    xy, _ = project(points @ truth[:3, :3].T + truth[:3, 3], camera)
    xy = xy + rng.normal(size=xy.shape) * 0.3
    near = se3.exp(np.array([0.02, 0, 0, 0, 0.01, 0])) @ truth
    solved = solve_pose(xy, points, camera, seed=1, start=near)
    assert not asked
    assert solved is not None
    assert solved.inliers.mean() > 0.97
    assert 0 < np.linalg.norm(se3.log(solved.cam_from_world @ se3.inverse(truth))) < 0.01
    far = se3.exp(np.array([0, 0, 0, 0, 0.6, 0])) @ truth
    again = solve_pose(xy, points, camera, seed=1, start=far)
    assert asked
    assert again is not None
    assert again.inliers.mean() > 0.97


def test_no_pose_from_nonsense() -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(640, 480, 500, 500, 320, 240)
    solved = solve_pose(
        rng.uniform(0, 1, (80, 2)) * [640, 480], rng.normal(size=(80, 3)) + np.array([0, 0, 5]), camera, 0
    )
    assert solved is None or solved.inliers.sum() < 16
    assert solve_pose(np.zeros((3, 2)), np.zeros((3, 3)), camera, 0) is None


def test_features_match_a_turned_picture_and_not_another() -> None:
    first = texture(3, (300, 300))
    turned = np.ascontiguousarray(np.rot90(first))
    a, b, other = (sift_features(x, 400, thresholds=(0.005,)) for x in (first, turned, texture(4, (300, 300))))
    pairs = match_descriptors(a.descriptors, b.descriptors)
    # (x, y) goes to (y, 300 - x) in a picture turned to the left.
    wanted = np.stack([a.xy[pairs[:, 0], 1], 300 - a.xy[pairs[:, 0], 0]], 1)
    close = np.linalg.norm(wanted - b.xy[pairs[:, 1]], axis=1) < 1.5
    assert len(pairs) > 100
    assert close.mean() > 0.95
    assert len(match_descriptors(a.descriptors, other.descriptors)) < 0.1 * len(pairs)


def test_state_comes_back_from_disk(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    state = TrackState(rng.normal(size=(5, 3)), rng.integers(0, 255, (5, 3)).astype(np.uint8))
    state.add_frame(4, np.eye(4), Sightings.of(np.array([1, 1, 3]), rng.normal(size=(3, 2)), 1.0), True, 0)
    state.add_frame(6, 2 * np.eye(4), NO_SIGHTINGS, False, 1)
    state.lost[5] = "too dark, ½"
    state.done = 7
    save_value(tmp_path / "s.npz", state)
    back = load_value(tmp_path / "s.npz")
    assert back.sightings[4].point.tolist() == [1, 3]
    for name in ("keyframes", "lost", "segment", "done"):
        assert getattr(back, name) == getattr(state, name)
    assert np.array_equal(back.points, state.points)
    assert np.array_equal(back.poses[6], 2 * np.eye(4))


@pytest.mark.parametrize(("frame", "wanted"), [(0, [3, 6]), (7, [6, 9, 3, 12]), (20, [12, 9])])
def test_nearest_keyframes(frame: int, wanted: list[int]) -> None:
    assert TrackState(keyframes=[3, 6, 9, 12]).nearest_keyframes(frame, 2) == wanted


CAMERA = Intrinsics(320, 240, 280, 280, 160, 120)


def picture() -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(240, 320)).astype(np.float32)
    return np.clip(128 + 300 * cv2.GaussianBlur(noise, (0, 0), 2.5), 0, 255).astype(np.uint8)


class OnePicture:
    """Every frame shows the same."""

    intrinsics = CAMERA

    def __init__(self) -> None:
        self._features = sift_features(picture(), 400, thresholds=(0.005,))

    def features(self, frame_id: int) -> Any:
        return self._features

    def descriptor(self, frame_id: int) -> Any:
        return np.ones(1)

    def similarities(self, descriptors: Any, keyframes: Any) -> Any:
        return np.ones((len(descriptors), len(keyframes)))


def add_place(state: TrackState, frame_id: int, cam_from_world: np.ndarray) -> None:
    """A keyframe at a pose that sees a point of its own at every feature."""
    xy = OnePicture().features(0).xy
    depth = np.random.default_rng(1).uniform(2, 4, len(xy))
    points = se3.transform(se3.inverse(cam_from_world), unproject(xy, depth, CAMERA))
    index = state.add_points(points, np.zeros((len(xy), 3), np.uint8))
    state.add_frame(frame_id, cam_from_world, Sightings.of(index, xy, 0.5), True, 0)


HERE, FAR = se3.exp(np.array([0.1, 0.2, 0, 0, 0.1, 0])), se3.exp(np.array([6.0, 0, 0, 0, 1.5, 0]))


@pytest.mark.parametrize(
    ("places", "found"),
    [([HERE], True), ([HERE, FAR], False), ([HERE, HERE], True)],
    ids=["one place", "two equal places", "one place seen twice"],
)
def test_a_frame_is_posed_only_where_the_answer_is_unique(places: list[np.ndarray], found: bool) -> None:
    state = TrackState()
    for n, place in enumerate(places):
        add_place(state, 10 + 40 * n, place)
    seen, solved = relocalise(30, state, OnePicture(), 0)  # type: ignore[arg-type]
    assert len(seen) > 100
    assert (solved is not None) == found
    if solved is not None:
        assert np.allclose(solved.cam_from_world, HERE, atol=1e-3)


@pytest.mark.parametrize("away", [0.0, 100.0])
@pytest.mark.parametrize(("apart", "joined"), [(0.1, True), (0.6, False)])
def test_two_ways_to_join_are_as_near_or_far_wherever_the_origin_is(away: float, apart: float, joined: bool) -> None:
    """Things lie 3 units before the camera, and a tenth of that may differ, ten or a hundred units from the origin."""
    shift = np.array([away, 0, 0])
    first, second = Similarity(1.0, np.eye(3), shift), Similarity(1.02, np.eye(3), shift + np.array([0, apart, 0]))
    assert agree(first, second, np.eye(4), depth=3.0) == joined


def test_a_feature_is_the_point_whose_sighting_is_within_two_pixels() -> None:
    seen = Sightings.of(np.array([7, 3]), np.array([[10.0, 10.0], [50.0, 20.0]]), 1.0)
    assert seen.points_at(np.array([[11.0, 11.0], [50.0, 22.5], [49.0, 20.0]])).tolist() == [7, -1, 3]
    assert seen.points_at(np.zeros((0, 2))).tolist() == []
    assert NO_SIGHTINGS.points_at(np.array([[1.0, 1.0]])).tolist() == [-1]
