"""What nothing joins to the rest is posed in a world of its own."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.read_config import load_config
from msgs_slam.pipelines.run.files import BACKBONE, SPARSE, TRAJECTORY
from msgs_slam.pipelines.tracking.stage import run as run_tracking
from tests.pipelines.tracking.conftest import MadeRun

OTHERS = (15, 18, 21, 23)
"""Keyframes of a second model; their pictures and those between are blank, so that nobody recognises anything."""


def track(made: MadeRun, open_stage: Callable[..., StageContext], least: int) -> tuple[dict, list[str]]:
    context = open_stage(made.run, "tracking", load_config(overrides=[f"frames.least_piece={least}"]))
    figures = run_tracking(context)
    context.folder.rename(made.run.stage("tracking"))
    return figures, context.warnings


def test_a_second_model_becomes_a_piece(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]
) -> None:
    made = make_run(tmp_path / "run", keyframes=(0, 3, 6, 9), blank=tuple(range(10, 24)))
    model = make_run(tmp_path / "other", keyframes=OTHERS, backbone_scale=0.7).run.find(BACKBONE)
    assert model is not None
    SPARSE.save(made.run.stage("frames") / "piece_2", model)
    figures, warnings = track(made, open_stage, least=4)
    assert figures["pieces"] == [4]
    assert figures["posed"] >= 10
    assert any("piece_2" in w and "15, 18, 21, 23" in w for w in warnings)

    assert not set(np.flatnonzero(made.run.load(TRAJECTORY, "tracking").is_posed)) & set(OTHERS)
    piece = made.run.load(TRAJECTORY, "tracking", piece="piece_2")
    assert np.flatnonzero(piece.is_posed).tolist() == [*OTHERS]
    assert len(made.run.load(SPARSE, "tracking", piece="piece_2").points_in_world) > 50
    found, truth = piece.centers[piece.is_posed], np.linalg.inv(made.cam_from_world[[*OTHERS]])
    moved = align_points(found, truth[:, :3, 3], with_scale=True).apply(found)
    assert 0 < np.linalg.norm(moved - truth[:, :3, 3], axis=1).max() < 0.02


def test_what_the_pictures_join_is_no_piece(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]
) -> None:
    made = make_run(tmp_path / "run", keyframes=(0, 3, 6, 9))
    model = make_run(tmp_path / "other", keyframes=OTHERS, backbone_scale=0.7).run.find(BACKBONE)
    assert model is not None
    SPARSE.save(made.run.stage("frames") / "piece_2", model)
    figures, _ = track(made, open_stage, least=4)
    assert (figures["pieces"], figures["posed"]) == ([], 24)
