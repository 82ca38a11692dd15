"""Descriptors, verification, candidates: the parts of structure from motion on planted data."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.frames.keyframes import choose_keyframes
from msgs_slam.pipelines.geometry.camera import ONE_CAMERA
from msgs_slam.pipelines.sfm import features as features_module
from msgs_slam.pipelines.sfm import matching
from msgs_slam.pipelines.sfm.consistency import epipolar_error, judge
from msgs_slam.pipelines.sfm.features import (
    THRESHOLDS,
    GlobalDescriptors,
    far_apart,
    global_descriptor,
    learn_vocabulary,
    loop_pairs,
    sequential_pairs,
    sift_features,
)
from msgs_slam.pipelines.sfm.matching import (
    MIN_INLIERS,
    VerifiedPair,
    match_descriptors,
    verify_matches,
    write_database,
)
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.sfm.two_views import rotation_residual, why_no_structure
from msgs_slam.pipelines.types import Features
from tests.pipelines.frames.conftest import FOCAL, HEIGHT, WIDTH, render, sideways, turn

CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, WIDTH, HEIGHT)


def _descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    values = rng.random((count, 128)) ** 4
    return np.round(np.sqrt(values / values.sum(1, keepdims=True)) * 512).clip(0, 255).astype(np.uint8)


def _two_views(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (200, 2) in two views of random points, and the two poses (3, 4)."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-1, -0.8, 2], [1, 0.8, 6], (200, 3))
    first = np.eye(4)[:3]
    second = np.column_stack([cv2.Rodrigues(np.array([0.05, -0.2, 0.02]))[0], [0.5, 0.05, 0.1]])
    xy = [CAMERA.img_from_cam(points @ p[:, :3].T + p[:, 3]) + rng.normal(0, noise, (200, 2)) for p in (first, second)]
    return xy[0], xy[1], first, second


def test_matching_finds_a_planted_permutation() -> None:
    rng = np.random.default_rng(0)
    first = _descriptors(rng, 300)
    order = rng.permutation(300)
    noisy = np.clip(first[order].astype(int) + rng.integers(-2, 3, (300, 128)), 0, 255).astype(np.uint8)
    matches = match_descriptors(first, noisy)
    assert len(matches) == 300
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])


def test_matching_equals_its_definition() -> None:
    rng = np.random.default_rng(1)
    pool = _descriptors(rng, 150)
    first, second = pool[:100], np.concatenate([pool[60:], pool[70:80]])  # with repetitions, which must be refused
    angle = np.arccos(np.clip(first.astype(float) @ second.astype(float).T / 512**2, 0, 1))
    expected = []
    for i in range(100):
        j, k = np.argsort(angle[i], kind="stable")[:2]
        if angle[i, j] < 1.2 and angle[i, j] < 0.9 * angle[i, k] and np.argmin(angle[:, j]) == i:
            expected.append((i, j))
    assert match_descriptors(first, second, (0.9, 1.2)).tolist() == [list(map(int, m)) for m in expected]
    assert 20 < len(expected) < 40


@pytest.mark.parametrize("dtype", [np.uint8, np.int8])
@pytest.mark.parametrize("products", [matching._float_products, matching._byte_products])
@pytest.mark.parametrize("columns", [2, 31, 32, 33, 100])
def test_the_two_nearest_are_those_of_numpy(
    columns: int, products: Callable[..., Any], dtype: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few different numbers, so that many are equal: the first of those is the nearest, the next the second. Rows
    come in parts, and all there is between bytes occurs."""
    if products is matching._byte_products and not matching._has_byte_products():
        pytest.skip("this processor has no products of bytes, and the program does not use them here")
    monkeypatch.setattr(matching, "_byte_products", products)
    monkeypatch.setattr(matching, "_float_products", products)
    monkeypatch.setattr(matching, "_ROWS", 16)
    rng, limits = np.random.default_rng(columns), np.iinfo(dtype)
    first, second = (np.full((n, 8), 1, dtype) for n in (40, columns))
    for table in (first, second):
        table[:, :2] = rng.integers(0, 3, (len(table), 2))
        table[0], table[1] = limits.min, limits.max
    similarity = first.astype(np.int64) @ second.astype(np.int64).T
    best, score, runner_up, best_back = matching._two_nearest(first, second)
    np.testing.assert_array_equal(best, similarity.argmax(1))
    np.testing.assert_array_equal(score, similarity.max(1))
    np.testing.assert_array_equal(runner_up, np.sort(similarity, axis=1)[:, -2])
    np.testing.assert_array_equal(best_back, similarity.argmax(0))


def test_verification_drops_outliers_and_depends_on_the_seed_and_the_pair_alone() -> None:
    first, second, _, _ = _two_views(noise=0.3)
    rng = np.random.default_rng(2)
    matches = np.stack([np.arange(200)] * 2, axis=1).astype(np.uint32)
    wrong = rng.permutation(200)[:60]
    matches[wrong, 1] = np.roll(matches[wrong, 1], 7)
    found = verify_matches((0, 1), matches, (first, second), CAMERA, 0)
    assert found is not None
    assert 120 <= len(found.matches) <= 150
    right = found.matches[:, 0] == found.matches[:, 1]
    assert right.mean() > 0.95
    verify_matches((3, 4), matches, (second, first), CAMERA, 9)
    again = verify_matches((0, 1), matches, (first, second), CAMERA, 0)
    assert again is not None
    np.testing.assert_array_equal(again.matches, found.matches)
    np.testing.assert_array_equal(again.matrices, found.matrices)


def test_unrelated_points_are_not_verified() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, 0], [WIDTH, HEIGHT], (2, 40, 2))
    matches = np.stack([np.arange(40)] * 2, axis=1).astype(np.uint32)
    assert verify_matches((0, 1), matches, (xy[0], xy[1]), CAMERA, 0) is None


def test_epipolar_error_is_pycolmaps_sampson_error() -> None:
    first, second, first_pose, second_pose = _two_views(noise=1.0)
    rays = [CAMERA.cam_from_img(v) for v in (first, second)]
    ours = epipolar_error(first_pose, second_pose, *rays)
    essential = pycolmap.essential_matrix_from_pose(pycolmap.Rigid3d(second_pose))
    squared = pycolmap.compute_squared_sampson_error(rays[0], rays[1], essential)
    np.testing.assert_allclose(ours**2, squared, rtol=1e-9)
    exact_first, exact_second, _, _ = _two_views()
    exact = epipolar_error(first_pose, second_pose, CAMERA.cam_from_img(exact_first), CAMERA.cam_from_img(exact_second))
    assert exact.max() < 1e-9 < np.median(ours)


def test_a_turn_is_told_from_a_step_without_the_focal_length() -> None:
    first, second, _, _ = _two_views(noise=0.3)
    turned_rays = np.column_stack([CAMERA.cam_from_img(first), np.ones(200)]) @ turn(0.15, 0.05)
    turned = CAMERA.img_from_cam(turned_rays) + np.random.default_rng(0).normal(0, 0.3, (200, 2))
    matches = np.stack([np.arange(200)] * 2, axis=1).astype(np.uint32)
    pair = VerifiedPair(0, 1, matches, 3, np.zeros((3, 3, 3)))
    size = (WIDTH, HEIGHT)
    step = min(rotation_residual(pair, (first, second), size, f) for f in np.geomspace(100, 1500, 30))
    only_turned = min(rotation_residual(pair, (first, turned), size, f) for f in np.geomspace(100, 1500, 30))
    assert 0 < only_turned < 1.5 < 5 < step


def test_sequential_pairs_reach_every_neighbour_and_no_pair_twice() -> None:
    pairs = sequential_pairs(30, 4)
    assert len(set(pairs)) == len(pairs)
    assert all(i < j for i, j in pairs)
    assert {(i, j) for i in range(30) for j in range(i + 1, min(30, i + 5))} <= set(pairs)
    assert len(sequential_pairs(300, 4)) < 6 * 300


def test_a_revisit_is_found_by_appearance() -> None:
    poses = list(sideways(8))
    views = [render(*p) for p in [*poses, *poses[1:3]]]
    features = [sift_features(cv2.cvtColor(v, cv2.COLOR_RGB2GRAY), 400) for v in views]
    vocabulary = learn_vocabulary(features, seed=0)
    descriptors = np.stack([global_descriptor(f, vocabulary) for f in features])
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, rtol=1e-5)
    pairs = loop_pairs(GlobalDescriptors((descriptors,)), far_apart(len(views), 5), per_frame=1)
    assert {(1, 8), (2, 9)} <= set(pairs)
    assert all(j - i >= 5 for i, j in pairs)
    np.testing.assert_array_equal(learn_vocabulary(features, seed=0).words, vocabulary.words)


def test_likeness_row_by_row_is_likeness_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long recording's table of all pairs never exists; the pairs are the same."""
    vectors = np.random.default_rng(0).standard_normal((2, 40, 16)).astype(np.float32)
    kinds = tuple(v / np.linalg.norm(v, axis=1, keepdims=True) for v in vectors)
    whole = GlobalDescriptors(kinds).rows(slice(0, 40))
    assert whole == pytest.approx(np.mean([v @ v.T for v in kinds], 0), abs=1e-6)
    pairs = loop_pairs(GlobalDescriptors(kinds), far_apart(40, 3), 2, least=0.1)
    monkeypatch.setattr(features_module, "_BLOCK", 7)
    assert np.array_equal(GlobalDescriptors(kinds).rows(slice(11, 20)), whole[11:20])
    assert loop_pairs(GlobalDescriptors(kinds), far_apart(40, 3), 2, least=0.1) == pairs
    assert pairs
    assert min(whole[i, j] for i, j in pairs) > 0.1


def test_of_nothing_there_is_nothing() -> None:
    few = _descriptors(np.random.default_rng(0), 1)
    assert len(match_descriptors(few, few)) == 0
    assert len(sift_features(np.full((100, 120), 128, np.uint8), 400)) == 0
    empty = Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    vocabulary = learn_vocabulary([empty, empty, empty], 0)
    described = GlobalDescriptors((np.stack([global_descriptor(empty, vocabulary)] * 3),))
    assert loop_pairs(described, far_apart(3, 1), 2) == []


def test_features_are_one_a_place_and_none_is_in_the_mask() -> None:
    grey = cv2.cvtColor(render(*next(iter(sideways(2)))), cv2.COLOR_RGB2GRAY)
    all_of_it = sift_features(grey, 400)
    assert len(np.unique(all_of_it.keypoints[:, :3], axis=0)) == len(all_of_it) > 100
    right = np.arange(WIDTH)[None].repeat(HEIGHT, 0) >= WIDTH // 2
    masked = sift_features(grey, 400, right)
    assert 50 < len(masked) < len(all_of_it)
    away = WIDTH // 2 - masked.xy[:, 0]
    assert (away > 2 * masked.keypoints[:, 2] - 1).all(), "what moves has no part in where a feature lies"
    near = (all_of_it.xy[:, 0] < WIDTH // 2) & (WIDTH // 2 - all_of_it.xy[:, 0] < 2 * all_of_it.keypoints[:, 2] - 1)
    assert near.any(), "without that, some would lie there"


def test_a_plain_wall_shows_enough_to_go_past_it() -> None:
    """Blotches of a few grey levels under noise; of a picture with more to see weaker features are not looked for."""
    rng = np.random.default_rng(0)
    blotches = cv2.GaussianBlur(rng.standard_normal((300, 420)), (0, 0), 8)
    wall = 150 + 3 * blotches / blotches.std()
    views = [np.round(wall[:240, x : x + 320] + 2 * rng.standard_normal((240, 320))).astype(np.uint8) for x in (10, 50)]
    strong, found = (
        [sift_features(v, 1500, thresholds=limits) for v in views] for limits in (THRESHOLDS[:1], THRESHOLDS)
    )

    def agreeing(features: list[Features]) -> int:
        matches = match_descriptors(*(f.descriptors for f in features))
        step = features[0].xy[matches[:, 0]] - features[1].xy[matches[:, 1]]
        return int((np.linalg.norm(step - [40, 0], axis=1) < 2).sum())

    assert agreeing(strong) < MIN_INLIERS < 2 * MIN_INLIERS < agreeing(found)
    grey = cv2.cvtColor(render(*next(iter(sideways(2)))), cv2.COLOR_RGB2GRAY)
    assert np.array_equal(sift_features(grey, 400).xy, sift_features(grey, 400, thresholds=THRESHOLDS[:1]).xy)


def _sliding(step: float, count: int) -> list[tuple[np.ndarray, None]]:
    wide = cv2.cvtColor(render(np.zeros(3), turn(0.0)), cv2.COLOR_RGB2GRAY)
    shifts = [np.float32([[1, 0, -step * i], [0, 1, 0]]) for i in range(count)]
    return [(cv2.warpAffine(wide, s, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), None) for s in shifts]


def test_keyframes_follow_the_displacement() -> None:
    # 4.5 px a frame, a keyframe after more than 5 % of 320 px = 16 px: each fourth frame.
    choice = choose_keyframes(_sliding(4.5, 20), 0.05)
    assert choice.keyframes[:4] == [0, 4, 8, 12]
    assert choice.displacement[1:5] * WIDTH == pytest.approx([4.5, 9, 13.5, 18], abs=0.5)


def test_frames_that_stand_are_no_keyframes_and_unrelated_ones_all_are() -> None:
    still = choose_keyframes(_sliding(0.0, 8), 0.05)
    assert still.keyframes == [0]
    assert still.largest_displacement < 0.001
    rng = np.random.default_rng(0)
    frames = [(cv2.resize(rng.integers(0, 255, (30, 40), dtype=np.uint8), (WIDTH, HEIGHT)), None) for _ in range(4)]
    assert choose_keyframes(frames, 0.05).keyframes == [0, 1, 2, 3]


def test_snapshots_come_back_as_they_were_and_are_not_computed_twice(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    features = Features(rng.random((9, 4)).astype(np.float32), _descriptors(rng, 9))
    pairs = [
        VerifiedPair(i, i + 2, rng.integers(0, 99, (5 + i, 2)).astype(np.uint32), 3, rng.random((3, 3, 3)))
        for i in range(3)
    ]
    snapshots = Snapshots(tmp_path)
    for compute in (True, False):
        calls: list[str] = []
        made = snapshots.value("features/4", lambda calls=calls: calls.append("f") or features)  # type: ignore[misc]
        found = snapshots.value("pairs/0", lambda calls=calls: calls.append("p") or pairs)  # type: ignore[misc]
        assert calls == (["f", "p"] if compute else [])
        np.testing.assert_array_equal(made.keypoints, features.keypoints)
        np.testing.assert_array_equal(made.descriptors, features.descriptors)
        for a, b in zip(found, pairs, strict=True):
            assert (a.first, a.second, a.config) == (b.first, b.second, b.config)
            np.testing.assert_array_equal(a.matches, b.matches)
            np.testing.assert_array_equal(a.matrices, b.matrices)
    assert snapshots.value("pairs/1", lambda: []) == snapshots.value("pairs/1", lambda: pairs) == []


def _known_model(bend: float) -> tuple[pycolmap.Reconstruction, list[VerifiedPair], list[np.ndarray]]:
    """A model of ten views of which the later half are turned by `bend` radians against the matches."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 10, 120
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    xy = [np.array([p.xy for p in model.images[i].points2D]) for i in range(1, 11)]
    points = [
        {p.point3D_id: k for k, p in enumerate(model.images[i].points2D) if p.has_point3D()} for i in range(1, 11)
    ]
    pairs = []
    for i in range(10):
        for j in range(i + 1, 10):
            common = sorted(points[i].keys() & points[j].keys())
            matches = np.array([(points[i][p], points[j][p]) for p in common], np.uint32)
            pairs.append(VerifiedPair(i, j, matches, 2, np.zeros((3, 3, 3))))
    swing = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.sin(bend / 2), 0.0, np.cos(bend / 2)])), np.zeros(3))
    for view in range(5, 10):
        frame = model.frames[view + 1]
        frame.rig_from_world = frame.rig_from_world * swing
    return model, pairs, xy


def test_a_folded_model_is_recognised() -> None:
    straight, folded = (judge(*_known_model(bend), total=10, reach=3) for bend in (0.0, 0.5))
    assert straight.is_sound
    assert straight.agreement > 0.99
    assert not folded.is_sound
    assert 0.2 < folded.pairs_agreeing < 0.8  # the pairs within either half still agree
    assert folded.score < 0.7 * straight.score
    assert [(s.before, s.after) for s in folded.contradicted] == [(4, 5)]
    assert not straight.contradicted


def test_pycolmap_reads_the_database(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    features = [Features(rng.random((20, 4)).astype(np.float32) * 100, _descriptors(rng, 20)) for _ in range(3)]
    matches = np.stack([np.arange(15), np.arange(15)[::-1]], axis=1).astype(np.uint32)
    pair = VerifiedPair(0, 2, matches, 3, np.stack([rng.random((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))]))
    for _ in range(2):  # the second replaces the first
        write_database(tmp_path / "a.db", CAMERA, ["x", "y", "z"], features, [pair], ONE_CAMERA.cam_from_rig)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        assert [i.name for i in database.read_all_images()] == ["x", "y", "z"]
        assert database.num_verified_image_pairs() == 1
        geometry = database.read_two_view_geometry(1, 3)
        np.testing.assert_array_equal(geometry.inlier_matches, matches)
        np.testing.assert_allclose(geometry.F, pair.matrices[0])
        np.testing.assert_array_equal(database.read_keypoints(2)[:, :2], features[1].keypoints[:, :2])


def test_keyframes_go_on_behind_a_blank_stretch() -> None:
    """A keyframe without a corner has no track to lose."""
    blank = np.full((HEIGHT, WIDTH), 128, np.uint8)
    walk = [render(center, rotation)[..., 1] for center, rotation in sideways(12)]
    choice = choose_keyframes(((picture, None) for picture in [blank] * 3 + walk), 0.025)
    assert choice.keyframes[:2] == [0, 3]
    assert len(choice.keyframes) > 6


def test_what_matches_rule_out_is_not_blamed() -> None:
    pairs = [VerifiedPair(i, i + 1, np.zeros((9, 2), np.uint32), 2, np.zeros((3, 3, 3))) for i in range(9)]
    assert "10 views match others, which rules out blur and plain surfaces. Possible" in why_no_structure(10, pairs)
    assert "2 images are too few" in why_no_structure(2, pairs[:1])
    assert "at least 1 more" in why_no_structure(2, pairs[:1])
    few = why_no_structure(10, pairs[:2])
    assert "pairs that match: 2. 7 views match no other. Possible causes: too little overlap" in few
    assert "fisheye" not in few
