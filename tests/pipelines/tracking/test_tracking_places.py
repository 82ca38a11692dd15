"""Six sides of a panorama are one camera: in the adjustment, and where a side sees nothing."""

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import CUBE, Rig, reduce_to_rig, rig_of
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.bundle import Bundle, adjust_bundle
from msgs_slam.pipelines.tracking.segments import split_segments
from msgs_slam.pipelines.tracking.state import Sightings, TrackState, sync_rig_poses
from msgs_slam.pipelines.types import Intrinsics

STATIONS = 5
RIG = rig_of(6, 6 * STATIONS)
CAMERA = Intrinsics(300, 300, 150.0, 150.0, 150.0, 150.0)


def _sides(rig_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """(30, 4, 4) of all sides at places (5, 4, 4), as `Rig` counts them."""
    return (RIG.motions[:, None] @ rig_from_world[None]).reshape(-1, 4, 4)


def _places(rng: np.random.Generator) -> NDArray[np.float64]:
    return np.asarray(
        se3.exp(np.concatenate([rng.normal(0, 0.5, (STATIONS, 3)), rng.normal(0, 0.3, (STATIONS, 3))], 1))
    )


def _bundle(poses: NDArray[np.float64], rng: np.random.Generator, noise: float) -> Bundle:
    """What all sides see of points on a ball about them."""
    points = rng.normal(size=(400, 3))
    points *= 4 / np.linalg.norm(points, axis=1, keepdims=True)
    cam, point, xy = [], [], []
    for c, pose in enumerate(poses):
        seen = se3.transform(pose, points)
        at = seen[:, :2] / seen[:, 2:] * 150 + 150
        inside = (seen[:, 2] > 0) & (at > 0).all(1) & (at < 300).all(1)
        cam.append(np.full(int(inside.sum()), c))
        point.append(np.flatnonzero(inside))
        xy.append(at[inside] + rng.normal(0, noise, (int(inside.sum()), 2)))
    count = sum(map(len, cam))
    zeros, ones, none = np.zeros(count), np.ones(count), np.full(count, -1)
    return Bundle(
        poses, points, np.concatenate(cam), np.concatenate(point), np.concatenate(xy), ones, zeros, ones, none
    )


def _spread(poses: NDArray[np.float64]) -> float:
    """How far the sides of a place are from being turned as in `CUBE` about one centre."""
    rigs = se3.inverse(np.repeat(RIG.motions, STATIONS, axis=0)) @ poses
    return float(np.ptp(rigs.reshape(6, STATIONS, 4, 4), axis=0).max())


def test_tied_blocks_are_the_system_in_the_places_steps() -> None:
    rng = np.random.default_rng(0)
    ids = rng.permutation(6 * STATIONS)[:12]
    full = rng.normal(size=(72, 72))
    full = full @ full.T
    pairs = np.argwhere(np.triu(np.ones((12, 12))) > 0)
    blocks = np.array([full[6 * a : 6 * a + 6, 6 * b : 6 * b + 6] for a, b in pairs])
    right = rng.normal(size=72)
    tied, kept, pull, place, turns = reduce_to_rig(blocks, pairs, right, ids, RIG)
    count = len(np.unique(ids % STATIONS))
    steps = np.zeros((72, 6 * count))
    for camera in range(12):
        steps[6 * camera : 6 * camera + 6, 6 * place[camera] : 6 * place[camera] + 6] = turns[camera]
    expected = steps.T @ full @ steps
    for (a, b), block in zip(kept, tied, strict=True):
        np.testing.assert_allclose(block, expected[6 * a : 6 * a + 6, 6 * b : 6 * b + 6], atol=1e-10)
    np.testing.assert_allclose(pull, steps.T @ right)
    # A step of the place moves each side by its own step: F exp(d) R = exp(turned d) F R.
    d, side = rng.normal(size=6) * 0.1, ids[3] // STATIONS
    pose = _sides(_places(rng))[ids[3]]
    moved = RIG.motions[side] @ se3.exp(d) @ se3.inverse(RIG.motions[side]) @ pose
    np.testing.assert_allclose(se3.exp(turns[3] @ d) @ pose, moved, atol=1e-12)


@pytest.mark.parametrize("dense", [True, False])
def test_sides_move_together_in_the_adjustment(dense: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not dense:
        monkeypatch.setattr("msgs_slam.pipelines.sfm.bundle.DENSE_CAMERAS", 0)
    rng = np.random.default_rng(1)
    true = _places(rng)
    bundle = _bundle(_sides(true), rng, noise=0.5)
    shaken = _sides(np.asarray(se3.exp(rng.normal(0, 0.02, (STATIONS, 6)))) @ true)
    start = Bundle(shaken, bundle.points + rng.normal(0, 0.05, bundle.points.shape), *list(vars(bundle).values())[2:])
    alone = adjust_bundle(start, CAMERA).bundle.cam_from_world
    tied = adjust_bundle(start, CAMERA, ids=np.arange(30), rig=RIG).bundle.cam_from_world
    assert _spread(tied) < 1e-9
    assert _spread(alone) > 1e-3

    def error(poses: NDArray[np.float64]) -> float:
        centers, wanted = se3.inverse(poses)[:, :3, 3], se3.inverse(_sides(true))[:, :3, 3]
        return float(np.linalg.norm(align_points(centers, wanted).apply(centers) - wanted, axis=1).max())

    assert 0 < error(tied) < 0.01
    assert error(tied) < error(alone)


def _state(true: NDArray[np.float64], posed: list[int]) -> TrackState:
    rng = np.random.default_rng(2)
    state = TrackState(rng.normal(size=(100, 3)), np.zeros((100, 3), np.uint8), rig=RIG)
    for i in posed:
        points = np.arange(10 * (i // STATIONS), 10 * (i // STATIONS) + 5 + i % STATIONS)
        seen = Sightings.of(points, np.full((len(points), 2), 3.0), 1.0)
        state.add_frame(i, true[i], seen, i % 2 == 0, 0)
    return state


def test_a_side_without_points_is_posed_by_the_others() -> None:
    true = _sides(_places(np.random.default_rng(3)))
    state = _state(true, [0, 5, 12, 18])
    state.lost = {1: "dark", 10: "blank", 4: "no side of its place is posed"}
    sync_rig_poses(state)
    assert sorted(state.poses) == sorted(RIG.frames_of([0, 2, 3]))
    assert state.lost == {1: "dark", 4: "no side of its place is posed"}
    assert state.keyframes == [0, 12, 18]
    for i, pose in state.poses.items():
        np.testing.assert_allclose(pose, true[i], atol=1e-12)


def test_sides_that_share_no_point_are_one_segment_by_their_place() -> None:
    true = _sides(_places(np.random.default_rng(3)))
    state = _state(true, [0, 2, 4, 10, 12])  # front and back of a place, further fronts
    for i in (10, 12):
        state.add_frame(i, true[i], state.sightings[i], True, 0)
    state.keyframes = [0, 2, 4, 10, 12]
    split_segments(state)
    assert set(state.segment.values()) == {0}
    state.rig = Rig(1 << 62, CUBE[:1])
    split_segments(state)
    assert len(set(state.segment.values())) == 2
