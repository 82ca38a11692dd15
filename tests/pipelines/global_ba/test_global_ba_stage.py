"""The stage hands on what tracking and mapping have left, as it is."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from msgs_slam.pipelines.config import Config, GlobalBaConfig
from msgs_slam.pipelines.depth.fields import FINE, DepthFields
from msgs_slam.pipelines.global_ba.stage import run as run_global_ba
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.run.files import BACKBONE, DEPTH_FIELDS, EXPOSURE, LOOPS, MAP, SPARSE, TRAJECTORY
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.types import LoopEdge, Trajectory
from tests.pipelines.tracking.conftest import MadeRun, make_run, open_stage, room_frames

__all__ = ["make_run", "open_stage", "room_frames"]


def test_results_are_taken_over_as_they_are(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]
) -> None:
    made = make_run(tmp_path / "run")
    model = made.run.find(BACKBONE)
    assert model is not None
    tracking, mapping = made.run.stage("tracking"), made.run.stage("mapping")
    tracking.mkdir()
    mapping.mkdir()
    ids, count = model.frame_ids, len(model.frame_ids)
    trajectory = Trajectory(ids, ids / 10, model.cam_from_world, np.ones(count, np.bool_), ("",) * count)
    nothing, balls = np.zeros((count, 3), np.float32), torch.zeros(5)
    SPARSE.save(tracking, model)
    DEPTH_FIELDS.save(tracking, DepthFields({0: np.zeros((FINE.rows, FINE.columns))}))
    LOOPS.save(tracking, [LoopEdge(0, 23, np.eye(4), 1.1, 40)])
    TRAJECTORY.save(mapping, trajectory)
    gaussians = GaussianMap(torch.zeros(5, 3), balls, balls, torch.zeros(5, 3), torch.zeros(5, 2), balls.long())
    MAP.save(mapping, gaussians)
    EXPOSURE.save(mapping, {"frame_ids": ids, "log_gains": nothing, "offsets": nothing})
    context = open_stage(made.run, "global_ba", replace(Config(), global_ba=GlobalBaConfig(posed="picked")))
    assert run_global_ba(context) == {}
    for stage, files in ((tracking, (SPARSE, DEPTH_FIELDS, LOOPS)), (mapping, (TRAJECTORY, MAP, EXPOSURE))):
        for file in files:
            assert file.path(context.folder).read_bytes() == file.path(stage).read_bytes()
