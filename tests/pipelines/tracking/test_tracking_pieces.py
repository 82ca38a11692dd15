"""What nothing joins to the rest is posed in a world of its own, and exported apart."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from pipelines.config import load_config
from pipelines.export.stage import write_pieces
from pipelines.geometry.alignment import align_points
from pipelines.outcome import load_outcome
from pipelines.run_folder import save_sparse
from pipelines.stages import StageContext
from pipelines.tracking.stage import STAGE
from tests.pipelines.finished import note_finished
from tests.pipelines.tracking.conftest import MadeRun

OTHERS = (15, 18, 21, 23)
"""Keyframes of a second model; their pictures and those between are blank, so that nobody recognises anything."""


def track(made: MadeRun, open_stage: Callable[..., StageContext], least: int) -> tuple[dict, list[str]]:
    context = open_stage(made.run, "tracking", load_config(overrides=[f"frames.least_piece={least}"]))
    figures = STAGE.run(context)
    context.folder.rename(made.run.stage("tracking"))
    return figures, context.warnings


def test_a_second_model_becomes_a_piece_and_is_exported(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]
) -> None:
    made = make_run(tmp_path / "run", keyframes=(0, 3, 6, 9), blank=tuple(range(10, 24)))
    model = make_run(tmp_path / "other", keyframes=OTHERS, backbone_scale=0.7).run.load_backbone()
    assert model is not None
    save_sparse(made.run.stage("frames") / "piece_2", model)
    figures, warnings = track(made, open_stage, least=4)
    assert figures["pieces"] == [4]
    assert figures["posed"] >= 10
    assert any("piece_2" in w and "15, 18, 21, 23" in w for w in warnings)

    assert not set(np.flatnonzero(made.run.load_trajectory("tracking").is_posed)) & set(OTHERS)
    note_finished(made.run, ("frames", "proxy", "tracking"))
    write_pieces(load_outcome(made.run, "cpu"), tmp_path / "export")
    exported = pycolmap.Reconstruction(tmp_path / "export" / "piece_2" / "sparse" / "0")
    centres = {i.name: i.projection_center() for i in exported.images.values()}
    assert sorted(centres) == [f"{i:06d}.png" for i in OTHERS]
    assert exported.num_points3D() > 50
    found, truth = np.array([centres[n] for n in sorted(centres)]), np.linalg.inv(made.cam_from_world[[*OTHERS]])
    moved = align_points(found, truth[:, :3, 3], with_scale=True).apply(found)
    assert 0 < np.linalg.norm(moved - truth[:, :3, 3], axis=1).max() < 0.02
    assert len((tmp_path / "export" / "piece_2" / "trajectory.txt").read_text().splitlines()) >= 4


def test_what_the_pictures_join_is_no_piece(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]
) -> None:
    made = make_run(tmp_path / "run", keyframes=(0, 3, 6, 9))
    model = make_run(tmp_path / "other", keyframes=OTHERS, backbone_scale=0.7).run.load_backbone()
    assert model is not None
    save_sparse(made.run.stage("frames") / "piece_2", model)
    figures, _ = track(made, open_stage, least=4)
    assert (figures["pieces"], figures["posed"]) == ([], 24)
