"""Loops on a made-up walk round a room: found, closed, not believed where they cannot be; VLAD."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.global_ba import loops
from msgs_slam.pipelines.global_ba.close import adjust_with_loops, reprojection_error
from msgs_slam.pipelines.global_ba.loops import (
    FoundLoops,
    LoopSearch,
    loop_candidates,
    make_keyframe_view,
    shared_points,
)
from msgs_slam.pipelines.sfm.features import GlobalDescriptors, global_descriptor, learn_vocabulary
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.types import Features, Intrinsics

Array = NDArray[np.float64]
CAMERA = Intrinsics(640, 480, 400, 400, 320, 240)


@dataclass(frozen=True)
class Walk:
    """Keyframes of a walk whose end passes over its beginning, though no point is known to be the same."""

    truth: Array
    model: SparseModel
    features: list[Features]

    @property
    def search(self) -> LoopSearch:
        state = TrackState.from_backbone(self.model, 0.5)
        rows = zip(self.model.frame_ids.tolist(), self.model.cam_from_world, self.features, strict=True)
        points = self.model.points_in_world
        views = [
            make_keyframe_view(i, p, f, state.sightings[i], points, np.zeros(len(f.xy)), CAMERA) for i, p, f in rows
        ]
        return LoopSearch(views, self.model.cam_from_world, CAMERA, 0)

    def pairs(self, refused: Collection[tuple[int, int]] = ()) -> list[tuple[int, int]]:
        vocabulary = learn_vocabulary(self.features, 0)
        looks = GlobalDescriptors((np.stack([global_descriptor(f, vocabulary) for f in self.features]),))
        return loop_candidates(self.model, looks, refused)

    def find(self) -> FoundLoops:
        return self.search.find(self.pairs())


def circle_poses(count: int, laps: float) -> Array:
    """Cameras on a circle of radius 1, search outwards."""
    out = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi * laps, count)):
        c, s = np.cos(angle), np.sin(angle)
        forward, right = np.array([c, 0, s]), np.array([-s, 0, c])
        world_from_cam = np.eye(4)
        world_from_cam[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        world_from_cam[:3, 3] = forward
        out[k] = np.linalg.inv(world_from_cam)
    return out


def make_walk(drift: float = 0.0, scale_drift: float = 0.0, twins: bool = False) -> Walk:
    """40 keyframes, 1.12 laps. With `twins` the far side of the room carries the same texture as the near one."""
    rng = np.random.default_rng(0)
    count = 2400
    angle = rng.uniform(0, 2 * np.pi, count)
    radius = rng.uniform(3, 4.5, count)
    points = np.stack([radius * np.cos(angle), rng.uniform(-1.5, 1.5, count), radius * np.sin(angle)], 1)
    words = np.abs(rng.normal(size=(count, 128)))
    if twins:
        half = count // 2
        points[half:] = points[:half] * [-1, 1, -1]
        words[half:] = words[:half]
    descriptors = np.round(512 * np.sqrt(words / words.sum(1, keepdims=True))).astype(np.uint8)
    truth = circle_poses(40, 1.12)
    features, frame, point, pixels = [], [], [], []
    for k, pose in enumerate(truth):
        xy, z = project(points @ pose[:3, :3].T + pose[:3, 3], CAMERA)
        seen = np.flatnonzero((z > 0.5) & (xy > 0).all(1) & (xy < [640, 480]).all(1))
        noisy = xy[seen] + rng.normal(size=(len(seen), 2)) * 0.4
        keypoints = np.concatenate([noisy, np.ones_like(noisy)], 1).astype(np.float32)
        features.append(Features(keypoints, descriptors[seen]))
        # In its second lap the walk does not know the points of the first again.
        point.append(seen + (count if k >= 34 else 0))
        frame.append(np.full(len(seen), k))
        pixels.append(noisy)
    poses, factors = drifted(truth, drift, scale_drift)
    world = np.concatenate([points, points])
    frames, owners = np.concatenate(frame), np.concatenate(point)
    first = np.full(len(world), 0)
    first[owners[::-1]] = frames[::-1]
    in_cam = np.einsum("pij,pj->pi", truth[first, :3, :3], world) + truth[first, :3, 3]
    back = se3.inverse(poses)[first]
    moved = np.einsum("pij,pj->pi", back[:, :3, :3], in_cam * factors[first, None]) + back[:, :3, 3]
    colors = np.zeros((len(world), 3), np.uint8)
    model = SparseModel(np.arange(40), poses, moved, colors, frames, owners, np.concatenate(pixels))
    return Walk(truth, model, features)


def drifted(truth: Array, angle: float, growth: float) -> tuple[Array, Array]:
    """Poses that turn and grow a little too much at every step, and each one's scale."""
    poses, factors = [truth[0]], [1.0]
    for k in range(1, len(truth)):
        step = truth[k] @ se3.inverse(truth[k - 1])
        step = se3.exp(np.array([0, 0, 0, 0.3 * angle, angle, 0])) @ step
        factors.append(factors[-1] * (1 + growth))
        step[:3, 3] *= factors[-1]
        poses.append(step @ poses[-1])
    return np.array(poses), np.array(factors)


def error(poses: Array, truth: Array) -> float:
    centres, wanted = se3.inverse(poses)[:, :3, 3], se3.inverse(truth)[:, :3, 3]
    moved = align_points(centres, wanted).apply(centres)
    return float(np.sqrt(((moved - wanted) ** 2).sum(1).mean()))


def test_candidates_are_revisits() -> None:
    walk = make_walk()
    pairs = walk.pairs()
    assert len(pairs) >= 4
    lap = 39 / 1.12
    apart = [abs(b - a - lap) for a, b in pairs[:4]]
    assert max(apart) < 5
    shared = shared_points(walk.model)
    assert all(shared[a, b] == 0 for a, b in pairs)
    assert shared[3, 4] > 100
    assert walk.pairs(refused=pairs[:2]) == pairs[2:]


def test_verified_loop_has_the_true_motion() -> None:
    walk = make_walk(drift=0.002, scale_drift=0.003)
    loop = walk.search.verify(2, 37)
    assert loop is not None
    truth = walk.truth[37] @ se3.inverse(walk.truth[2])
    apart = se3.log(loop.edge.frame2_from_frame1 @ se3.inverse(truth))
    assert 0 < np.linalg.norm(apart) < 0.05
    # The second lap has grown by 0.3 % at each of the steps since the first sighting of its points.
    assert loop.edge.scale == pytest.approx(1.003**35, rel=0.02)


def test_places_without_overlap_are_not_verified() -> None:
    assert make_walk().search.verify(2, 20) is None


@pytest.mark.parametrize(("drift", "growth"), [(0.0, 0.0), (0.0015, 0.001), (-0.001, -0.002)])
def test_closing_takes_the_drift_away(drift: float, growth: float) -> None:
    walk = make_walk(drift, growth)
    found = walk.find()
    assert len(found.loops) >= 3
    state = TrackState.from_backbone(walk.model, 0.5)
    before = error(walk.model.cam_from_world, walk.truth)
    closed = adjust_with_loops(state, found.loops, drift != 0, CAMERA, lambda _: None, False, True)
    after = error(np.array([state.poses[k] for k in range(40)]), walk.truth)
    assert 0 < after < 0.004
    assert drift == 0 or before > 0.015
    assert closed.error_after <= closed.error_before * 1.1


def test_equal_texture_on_the_far_side_is_no_loop() -> None:
    search = make_walk(twins=True).search
    # The pair matches and verifies: appearance and local geometry cannot know better.
    trap = search.verify(2, 20)
    assert trap is not None
    assert trap.edge.inliers > 50
    found = search.find([(2, 20), (3, 21), (4, 22), (2, 37), (3, 38)])
    assert found.implausible == 3
    assert {(x.edge.frame1_id, x.edge.frame2_id) for x in found.loops} == {(2, 37), (3, 38)}


def test_a_weak_loop_needs_a_neighbour_that_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    search = make_walk().search
    monkeypatch.setattr(loops, "SURE_INLIERS", 10**6)
    assert len(search.find([(2, 37)]).loops) == 1
    monkeypatch.setattr(loops, "AGREEMENT", 1e-3)
    found = search.find([(2, 37)])
    assert (len(found.loops), found.unsupported) == (0, 1)


def test_reprojection_error_is_that_of_the_noise() -> None:
    state = TrackState.from_backbone(make_walk().model, 0.5)
    # Median of a Rayleigh variable of sigma 0.4.
    assert reprojection_error(state, CAMERA) == pytest.approx(0.4 * 1.1774, rel=0.05)


def test_the_same_place_looks_alike_and_others_by_chance() -> None:
    rng = np.random.default_rng(0)

    def seen(place: np.ndarray) -> Features:
        words = np.abs(place + rng.normal(size=place.shape) * 0.1)
        root = 512 * words / np.linalg.norm(words, axis=1, keepdims=True)
        return Features(np.zeros((len(root), 4), np.float32), np.round(root).clip(0, 255).astype(np.uint8))

    places = [np.abs(rng.normal(size=(200, 128))) for _ in range(6)]
    frames = [seen(places[i]) for i in (0, 1, 2, 3, 4, 5, 0)]
    vocabulary = learn_vocabulary(frames, 0)
    vectors = np.stack([global_descriptor(f, vocabulary) for f in frames])
    scores = vectors @ vectors[0]
    assert scores[1:6].max() < 0 < 0.5 < scores[6]
    assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
