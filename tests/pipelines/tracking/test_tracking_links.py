"""Links on a made-up walk round a room: found, closed, not believed where they cannot be; segments joined; VLAD."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.sfm.features import GlobalDescriptors, global_descriptor, learn_vocabulary
from msgs_slam.pipelines.tracking import links
from msgs_slam.pipelines.tracking.adjust import adjust_state
from msgs_slam.pipelines.tracking.graph import reprojection_error, spread_drift
from msgs_slam.pipelines.tracking.links import Link, LinkSearch, add_sightings, loop_candidates, shared_points
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.types import Features, Intrinsics

Array = NDArray[np.float64]
CAMERA = Intrinsics(640, 480, 400, 400, 320, 240)


class Looks:
    """What a search asks of the pictures."""

    intrinsics = CAMERA

    def __init__(self, features: Sequence[Features]) -> None:
        self._features, vocabulary = features, learn_vocabulary(features, 0)
        self._looks = np.stack([global_descriptor(f, vocabulary) for f in features])

    def features(self, frame_id: int) -> Features:
        return self._features[frame_id]

    def descriptors(self, keyframes: Sequence[int]) -> NDArray[np.float32]:
        return self._looks[list(keyframes)]

    def similarities(self, descriptors: NDArray[np.float32], keyframes: Sequence[int]) -> NDArray[np.float32]:
        return descriptors @ self.descriptors(keyframes).T


@dataclass(frozen=True)
class Walk:
    """Keyframes of a walk whose end passes over its beginning, though no point is known to be the same."""

    truth: Array
    model: SparseModel
    looks: Any

    def search(self) -> LinkSearch:
        return LinkSearch(TrackState.from_backbone(self.model, 0.5), self.looks, 0)

    def pairs(self, refused: Collection[tuple[int, int]] = ()) -> list[tuple[int, int]]:
        looks = GlobalDescriptors((self.looks.descriptors(range(40)),))
        return loop_candidates(self.search().state, looks, refused)


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
    return Walk(truth, model, Looks(features))


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
    shared = shared_points(walk.search().state)
    assert all(shared[a, b] == 0 for a, b in pairs)
    assert shared[3, 4] > 100
    assert walk.pairs(refused=pairs[:2]) == pairs[2:]


def test_a_link_has_the_true_motion_and_scale() -> None:
    walk = make_walk(drift=0.002, scale_drift=0.003)
    link = walk.search().recognise(37, [2])
    assert link is not None
    truth = walk.truth[37] @ se3.inverse(walk.truth[2])
    apart = se3.log(link.edge.frame2_from_frame1 @ se3.inverse(truth))
    assert 0 < np.linalg.norm(apart) < 0.05
    # The second lap has grown by 0.3 % at each of the steps since the first sighting of its points.
    assert link.edge.scale == pytest.approx(1.003**35, rel=0.02)
    assert links.SCALE_SD <= link.scale_sd <= links.MAX_SCALE_SD


def test_places_without_overlap_are_not_linked() -> None:
    assert make_walk().search().recognise(20, [2]) is None


def test_a_link_that_tells_no_scale_is_none() -> None:
    """A pose alone would put what is behind it at any size."""
    search = make_walk().search()
    state = search.state
    state.sightings[37] = state.sightings[37].select(np.arange(5))
    assert search.recognise(37, [2]) is None


@pytest.mark.parametrize(("drift", "growth"), [(0.0, 0.0), (0.0015, 0.001), (-0.001, -0.002)])
def test_closing_takes_the_drift_away(drift: float, growth: float) -> None:
    walk = make_walk(drift, growth)
    search = walk.search()
    state = search.state
    loops = search.loops(list)
    assert len(loops) >= 3
    before, known, error_before = error(walk.model.cam_from_world, walk.truth), dict(state.sightings), 0.4 * 1.1774
    spread_drift(state, loops, CAMERA, dict(state.segment))
    add_sightings(state, loops)
    adjust_state(state, CAMERA, lambda _: None, False, True)
    after = error(np.array([state.poses[k] for k in range(40)]), walk.truth)
    assert 0 < after < 0.004
    assert drift == 0 or before > 0.015
    assert reprojection_error(state, CAMERA, known) <= error_before * 1.1


def test_equal_texture_on_the_far_side_is_no_loop() -> None:
    search = make_walk(twins=True).search()
    # The pair matches: appearance and local geometry cannot know better.
    trap = search.recognise(20, [2])
    assert trap is not None
    assert trap.edge.inliers > 50
    loops = search.loops(list)
    assert loops
    assert all(abs(n.edge.frame2_id - n.edge.frame1_id - 39 / 1.12) < 5 for n in loops)


def test_a_loop_needs_a_second_that_agrees(monkeypatch: pytest.MonkeyPatch) -> None:
    search = make_walk().search()
    (only,) = [pair for pair in make_walk().pairs() if pair[1] == 37][:1]
    monkeypatch.setattr(links, "loop_candidates", lambda *_: [only])
    assert [n.frame_id for n in search.loops(list)] == [37]
    monkeypatch.setattr(links, "agree", lambda *_: False)
    assert search.loops(list) == []


@pytest.mark.parametrize("size", [1.5, 5.9, 0.3])
def test_segments_are_joined_at_one_scale_wherever_they_recognise_each_other(size: float) -> None:
    """The second lap lies elsewhere, is of another size, and shows what the first does."""
    walk = make_walk()
    search = walk.search()
    state = search.state
    away = Similarity(size, se3.exp(np.array([0, 0, 0, 0.3, -0.5, 0.2]))[:3, :3], np.array([4.0, -2, 1]))
    late = range(34, 40)
    for k in range(40):  # no point is seen by both laps
        mine = (state.sightings[k].point >= 2400) == (k in late)
        state.sightings[k] = state.sightings[k].select(mine)
    for k in late:
        state.segment[k] = 1
    links.move_segment(1, 1, away, state)
    assert error(np.array([state.poses[k] for k in range(40)]), walk.truth) > 0.3
    found_links = search.join_segments()
    assert set(state.segment.values()) == {0}
    assert len({n.frame_id for n in found_links}) > 1
    assert all(n.edge.scale == pytest.approx(1.0, abs=0.05) for n in found_links)
    assert 0 < error(np.array([state.poses[k] for k in range(40)]), walk.truth) < 0.03
    add_sightings(state, found_links)
    assert (shared_points(state)[2:5, 36:39].toarray() > 20).any()


def test_a_film_does_not_join_rooms_that_only_look_alike() -> None:
    """The far side of the room is taken for the near one: the camera would leap from one keyframe to the next, but
    where nothing says that these follow on each other, and the film may have a cut."""
    beside = [(3, 5), (14, 16), (17, 20)]
    for near, pause, segments in (
        ([], 0, {0}),
        ([(3, 5), (15, 18)], 0, {0, 1}),
        (beside, 0, {0}),
        (beside, 0.3, {0, 1}),
    ):
        times = np.arange(40) / 4 + pause * (np.arange(40) >= 17)
        search = replace(make_walk(twins=True).search(), near=near, times=times)
        state = search.state
        for k in range(40):
            late = 17 <= k < 25
            state.sightings[k] = state.sightings[k].select((state.sightings[k].point % 2400 >= 1200) == late)
            state.segment[k] = int(late)
        search.join_segments()
        assert set(state.segment.values()) == segments


@pytest.mark.parametrize("is_flat", [False, True])
def test_segments_that_share_one_plane_of_a_room_are_not_joined(is_flat: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    search = make_walk().search()
    for k in range(34, 40):
        search.state.segment[k] = 1
    counts = set[bool]()

    def flat(points: NDArray[np.float64], around: NDArray[np.float64]) -> bool:
        counts.add(20 < len(points) < len(around))
        return is_flat

    monkeypatch.setattr(links, "is_flat_within", flat)
    search.join_segments()
    assert (set(search.state.segment.values()), counts) == ({0, 1} if is_flat else {0}, {True})


def test_stretches_are_compared_again_only_with_what_has_joined_since(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segment 2 is recognised at once, 3 only after 4; 5 joins 1, which nothing ties to the largest."""
    state, asked = TrackState(), []
    sizes = {0: 9, 1: 8, 2: 7, 3: 6, 4: 5, 5: 4}
    state.segment = {100 * s + n: s for s, count in sizes.items() for n in range(count)}

    def between(_: Any, segment: int, main: int) -> list[Any]:
        asked.append((segment, main))
        joins = segment in (2, 4) if main == 0 else (segment, main) == (5, 1)
        joins = joins or ((segment, main) == (3, 0) and 4 not in state.segment.values())
        return [replace(link, edge=replace(link.edge))] if joins else []

    def move(segment: int, main: int, *_: Any) -> None:
        state.segment = {i: main if s == segment else s for i, s in state.segment.items()}

    link = make_walk().search().recognise(37, [2])
    assert isinstance(link, Link)
    monkeypatch.setattr(LinkSearch, "_between", between)
    monkeypatch.setattr(links, "move_segment", move)
    assert len(LinkSearch(state, None, 0).join_segments()) == 4  # type: ignore[arg-type]
    assert set(state.segment.values()) == {0, 1}
    assert (1, 0) in asked
    assert asked[-1] == (5, 1)


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
