"""A lost frame is found again, unless two places explain it equally well."""

from typing import Any

import cv2
import numpy as np
import pytest

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import unproject
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.sfm.features import sift_features
from msgs_slam.pipelines.tracking.pnp import relocalise
from msgs_slam.pipelines.tracking.segments import agree
from msgs_slam.pipelines.tracking.state import NO_SIGHTINGS, Sightings, TrackState
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(320, 240, 280, 280, 160, 120)


def picture() -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(240, 320)).astype(np.float32)
    return np.clip(128 + 300 * cv2.GaussianBlur(noise, (0, 0), 2.5), 0, 255).astype(np.uint8)


class OnePicture:
    """Every frame shows the same."""

    intrinsics = CAMERA

    def __init__(self) -> None:
        self._features = sift_features(picture(), 400, threshold=0.005)

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
