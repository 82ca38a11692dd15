"""A camera that turns on the spot keeps its rotation; one that walks, or shows another place, is not taken for one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.tracking.front_end import fit_rotation, turn_between
from msgs_slam.pipelines.tracking.stage import run as run_tracking
from msgs_slam.pipelines.tracking.stage import warn_of_stretches
from msgs_slam.pipelines.tracking.state import Pictures
from msgs_slam.pipelines.types import Frame, Intrinsics, Trajectory
from tests.pipelines.tracking.conftest import MadeRun
from tests.world.clip import ClipOptions, WorldFrame, develop, make_world, render_view

LAST = 23
"""Of the walk; what comes after stands where it does."""


def seen_from(poses: list[np.ndarray]) -> list[WorldFrame]:
    """Pictures of the same room as the walk's, of the same size."""
    world, options = make_world("room", seed=3, texel=0.01), ClipOptions(width=320, height=240)
    out = []
    for pose in poses:
        color, depth, solid = render_view(world, options, pose)
        labels = np.append(world.labels, np.uint8(0))[solid]
        out.append(WorldFrame(develop(color, options, 0), depth, labels, pose, 0.0))
    return out


def turned_by(world_from_cam: np.ndarray, degrees: float) -> np.ndarray:
    """The camera turned about the room's vertical, its place kept."""
    out = world_from_cam.copy()
    out[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ out[:3, :3]
    return out


def moved_by(world_from_cam: np.ndarray, metres: float) -> np.ndarray:
    """The camera moved sideways."""
    out = world_from_cam.copy()
    out[:3, 3] += metres * out[:3, 0]
    return out


@pytest.fixture(scope="module")
def last_pose(room_frames: tuple[Intrinsics, list[WorldFrame]]) -> np.ndarray:
    return room_frames[1][LAST].world_from_cam


def test_a_turn_away_keeps_its_frames_and_says_so(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext], last_pose: np.ndarray
) -> None:
    angles = np.arange(12, 97, 12)
    made = make_run(tmp_path / "run", more=seen_from([turned_by(last_pose, a) for a in angles]))
    context = open_stage(made.run, "tracking")
    figures = run_tracking(context)
    context.folder.rename(made.run.stage("tracking"))

    found = made.run.load(TRAJECTORY, "tracking")
    turned = np.flatnonzero(found.by_rotation)
    assert found.is_posed.all()
    assert turned.min() > LAST, "frames of the walk are placed by what they see"
    assert len(turned) >= 4, "the turn leads away from all that has depth"
    assert (figures["by_rotation"], figures["posed"]) == (len(turned), LAST + 1 + len(angles))
    assert not (found.is_placed & found.by_rotation).any()
    anchor = int(turned.min()) - 1
    assert np.allclose(found.centers[turned], found.centers[anchor], atol=1e-9)
    truth = made.cam_from_world
    for i in turned.tolist():
        wanted, got = (p[i] @ se3.inverse(p[anchor]) for p in (truth, found.cam_from_world))
        assert 0 < se3.rotation_angle(got @ se3.inverse(wanted)) < np.radians(1.5)
    assert any("rotation alone" in w and f"{turned[0]}-{turned[-1]}" in w for w in context.warnings)


def test_a_walk_is_no_turn_nor_is_another_place(
    tmp_path: Path, make_run: Callable[..., MadeRun], last_pose: np.ndarray
) -> None:
    beside, behind = moved_by(last_pose, 0.5), turned_by(last_pose, 150)
    more = seen_from([turned_by(last_pose, 12), beside, turned_by(beside, 12), behind])
    run = make_run(tmp_path / "run", more=more).run
    pictures = Pictures(run, Config().frames)
    turn, beside_id, turned_too, behind_id = range(LAST + 1, LAST + 5)
    found = turn_between(LAST, turn, pictures, 0)
    assert found is not None
    truth = se3.inverse(turned_by(last_pose, 12)) @ last_pose
    assert 0 < se3.rotation_angle(found @ se3.inverse(truth)) < np.radians(0.5)
    assert np.array_equal(found, turn_between(LAST, turn, pictures, 0))
    for other in (beside_id, turned_too, behind_id):
        assert turn_between(LAST, other, pictures, 0) is None


def test_a_rotation_is_found_among_wrong_matches() -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(640, 480, 500, 500, 320, 240)
    truth = Rotation.from_rotvec([0.05, -0.2, 0.1]).as_matrix()
    xy = rng.uniform(0, 1, (100, 2)) * [640, 480]
    rays = np.column_stack([(xy - [320, 240]) / 500, np.ones(100)]) @ truth.T
    there = rays[:, :2] / rays[:, 2:] * 500 + [320, 240] + rng.normal(size=(100, 2))
    there[60:] = rng.uniform(0, 1, (40, 2)) * [640, 480]
    rotation, agree = fit_rotation(xy, there, camera, rng)
    assert agree[:60].all()
    assert agree[60:].sum() < 3
    assert 0 < Rotation.from_matrix(rotation @ truth.T).magnitude() < np.radians(0.1)


def test_of_trajectories_of_retired_settings_every_pose_has_its_place() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    old = Trajectory(np.arange(3), np.arange(3.0), poses, np.array([True, False, False]), ("", "", "lost"))
    assert old.is_placed.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("unplaced", "seconds", "wanted"),
    [
        ([*range(12)], 0.1, ["from 0.0 to 1.1 s (frames 0-11)"]),
        ([0, 1, 2, 3, 6, 8, 9, 10], 0.1, ["from 0.0 to 1.0 s (frames 0-10)"]),
        ([*range(10)], 0.1, []),
        ([*range(5), *range(20, 25)], 0.1, []),
        ([*range(12), *range(25, 38)], 0.1, ["frames 0-11", "frames 25-37"]),
        ([*range(12)], 1.0, []),
        ([], 0.1, []),
    ],
    ids=["long", "with gaps", "short", "two short", "two", "photographs", "none"],
)
def test_long_stretches_without_a_position_are_told_with_their_times(
    unplaced: list[int], seconds: float, wanted: list[str], open_stage: Callable[..., StageContext], tmp_path: Path
) -> None:
    context = open_stage(RunFolder(tmp_path), "tracking")
    warn_of_stretches(context, [Frame(i, f"{i}.png", seconds * i, i, 1.0) for i in range(40)], unplaced)
    assert len(context.warnings) == len(wanted)
    assert all(part in said for part, said in zip(wanted, context.warnings, strict=True))
