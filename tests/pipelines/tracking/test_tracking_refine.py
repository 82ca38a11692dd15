"""Render-and-compare finds the way back to a near pose, and does not believe a picture of nothing."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.run.files import BACKBONE
from msgs_slam.pipelines.tracking.front_end import RENDER_LOSS
from msgs_slam.pipelines.tracking.pictures import Pictures
from msgs_slam.pipelines.tracking.refine import compare_frame
from msgs_slam.pipelines.tracking.state import TrackState
from tests.pipelines.tracking.conftest import MadeRun


def test_comparison_brings_a_pose_nearer(tmp_path: Path, make_run: Callable[..., MadeRun]) -> None:
    made = make_run(tmp_path / "run", keyframes=(9, 12), backbone_scale=1.0, blank=(11,))
    backbone = made.run.find(BACKBONE)
    assert backbone is not None
    state = TrackState.from_backbone(backbone, 0.5)
    for k in (9, 12):
        state.poses[k] = made.cam_from_world[k]
    pictures = Pictures(made.run, FramesConfig())
    truth = made.cam_from_world[10]
    start = se3.exp(np.array([0.025, -0.02, 0.025, 0.008, -0.01, 0.005])) @ truth
    found = compare_frame(10, start, [9, 12], state, pictures)
    assert found is not None
    assert found.is_better
    assert 0 < found.loss_after < found.loss_before
    before, after = (np.linalg.norm(se3.log(p @ se3.inverse(truth))) for p in (start, found.cam_from_world))
    assert 0 < after < 0.5 * before
    assert found.unexplained < RENDER_LOSS
    nothing = compare_frame(11, made.cam_from_world[11], [9, 12], state, pictures)
    assert nothing is None or nothing.unexplained > 1
    # Without depth there is nothing to compare with.
    assert compare_frame(10, start, [10], _with_keyframe(state, 10, truth), pictures) is None


def _with_keyframe(state: TrackState, frame_id: int, pose: np.ndarray) -> TrackState:
    state.add_frame(frame_id, pose, state.sightings[9].select(np.zeros(0, int)), True, 0)
    return state
