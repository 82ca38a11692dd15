"""A camera that turns away from all that has depth has no pose; long stretches without one are told."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.tracking.stage import run as run_tracking
from msgs_slam.pipelines.tracking.stage import warn_of_stretches
from msgs_slam.pipelines.types import Frame, Intrinsics
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


@pytest.fixture(scope="module")
def last_pose(room_frames: tuple[Intrinsics, list[WorldFrame]]) -> np.ndarray:
    return room_frames[1][LAST].world_from_cam


def test_a_turn_away_is_lost_and_said(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext], last_pose: np.ndarray
) -> None:
    angles = np.arange(12, 97, 12)
    made = make_run(tmp_path / "run", more=seen_from([turned_by(last_pose, a) for a in angles]))
    context = open_stage(made.run, "tracking")
    figures = run_tracking(context)
    context.folder.rename(made.run.stage("tracking"))

    found = made.run.load(TRAJECTORY, "tracking")
    turned = np.flatnonzero(~found.is_posed)
    assert turned.min() > LAST, "frames of the walk are placed by what they see"
    assert len(turned) >= 4, "the turn leads away from all that has depth"
    assert figures["posed"] == found.is_posed.sum()
    assert {int(i) for i in figures["lost"]} == {*turned.tolist()}
    assert any(f"{len(turned)} frames have no pose" in w for w in context.warnings)
    assert all(found.lost_reasons[i] for i in turned)


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
