"""A loop whose second half has grown by an eighth: closed, refining map and poses together keeps the depth right."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.depth.fields import FINE, DepthFields
from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.evaluation.image_quality import DepthErrorSum
from msgs_slam.pipelines.evaluation.views import view_map
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.global_ba.stage import run as run_global_ba
from msgs_slam.pipelines.mapping.views import occurring_classes
from msgs_slam.pipelines.read_config import load_config
from msgs_slam.pipelines.run.files import (
    BACKBONE,
    CALIBRATION,
    DEPTH_FIELDS,
    EXPOSURE,
    MAP,
    PROXY_MAPS,
    SPARSE,
    TRAJECTORY,
)
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import Trajectory
from tests.pipelines.global_ba.test_global_ba_stage import FIRST_AGAIN, seeded_map
from tests.pipelines.tracking.conftest import MadeRun, make_run, open_stage, room_frames
from tests.world.clip import WorldFrame

__all__ = ["make_run", "open_stage", "room_frames"]
Array = NDArray[np.float64]
GROWTH = 1.12
SETTINGS = ["mapping.max_side=128"]


def grown_about(center: Array) -> Similarity:
    return Similarity(GROWTH, np.eye(3), (1 - GROWTH) * center)


def drifted(model: SparseModel, grown: Similarity) -> SparseModel:
    """The keyframes from FIRST_AGAIN on, and their own copies of the points, in a world grown about its first."""
    late = model.frame_ids >= FIRST_AGAIN
    poses = model.cam_from_world.copy()
    poses[late] = grown.apply_to_poses(poses[late])
    points = np.concatenate([model.points_in_world, grown.apply(model.points_in_world)])
    numbers = model.obs_point + len(model.points_in_world) * late[model.obs_frame]
    colors = np.concatenate([model.colors, model.colors])
    return SparseModel(model.frame_ids, poses, points, colors, model.obs_frame, numbers, model.obs_xy)


def finish_mapping(made: MadeRun, frames: list[WorldFrame]) -> None:
    """What tracking and mapping would have left: depths, poses, points and map of the second half all grown alike."""
    run = made.run
    for stage in ("tracking", "mapping"):
        run.stage(stage).mkdir()
    backbone = run.find(BACKBONE)
    assert backbone is not None
    grown = grown_about(se3.inverse(made.cam_from_world)[FIRST_AGAIN, :3, 3])
    model = drifted(replace(backbone, cam_from_world=made.cam_from_world[backbone.frame_ids]), grown)
    keyframes = model.frame_ids.tolist()
    SPARSE.save(run.stage("tracking"), model)
    scale = {k: GROWTH if k >= FIRST_AGAIN else 1.0 for k in keyframes}
    fields = {k: np.full((FINE.rows, FINE.columns), np.log(s)) for k, s in scale.items()}
    DEPTH_FIELDS.save(run.stage("tracking"), DepthFields(fields))
    poses = made.cam_from_world.copy()
    poses[FIRST_AGAIN:] = grown.apply_to_poses(poses[FIRST_AGAIN:])
    ids = np.arange(len(frames))
    trajectory = Trajectory(ids, ids / 10, poses, np.isin(ids, keyframes), ("",) * len(frames))
    TRAJECTORY.save(run.stage("mapping"), trajectory)
    class_ids = occurring_classes([run.load(PROXY_MAPS, of=k).labels for k in keyframes])
    scaled = [replace(f, depth=f.depth * scale.get(i, 1.0)) for i, f in enumerate(frames)]
    MAP.save(run.stage("mapping"), seeded_map(scaled, poses, keyframes, run, len(class_ids)))
    nothing = np.zeros((len(keyframes), 3), np.float32)
    EXPOSURE.save(run.stage("mapping"), {"frame_ids": model.frame_ids, "log_gains": nothing, "offsets": nothing})
    write_json(run.stage("mapping") / "mapping.json", {"class_ids": list(class_ids)})


def depth_error(run: RunFolder, stage: str, frames: list[WorldFrame]) -> float:
    """Mean error of the map's depth at the keyframes, metres after one scale."""
    trajectory, gaussian_map = run.load(TRAJECTORY, stage), run.load(MAP, stage)
    camera = run.load(CALIBRATION).intrinsics.resized(160, 120)
    total = DepthErrorSum()
    for row in np.flatnonzero(trajectory.is_keyframe):
        shown = view_map(gaussian_map, np.zeros(64, np.uint8), camera, trajectory.cam_from_world[row])
        total.add(shown.depth, frames[row].depth[1::2, 1::2])
    found = total.result()
    assert found is not None
    return found.scaled_l1


@pytest.fixture
def close(
    tmp_path: Path,
    make_run: Callable[..., MadeRun],
    room_frames: tuple[object, list[WorldFrame]],
    open_stage: Callable[..., StageContext],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[[str], tuple[RunFolder, dict]]:
    """close(joint): a run whose loop is closed, and the stage's figures."""
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.candidates.MIN_ALIKE", -1.0)
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.candidates.GAP", 2)

    def run(joint: str) -> tuple[RunFolder, dict]:
        made = make_run(tmp_path / joint, keyframes=tuple(range(0, 24, 2)), backbone_scale=1.0, metric=False)
        finish_mapping(made, room_frames[1])
        context = open_stage(made.run, "global_ba", load_config(overrides=[*SETTINGS, f"global_ba.joint={joint}"]))
        figures = run_global_ba(context)
        shutil.rmtree(context.folder / "snapshot", ignore_errors=True)
        context.folder.rename(made.run.stage("global_ba"))
        return made.run, figures

    return run


def test_refining_after_a_loop_does_not_bring_back_its_drift(
    close: Callable[[str], tuple[RunFolder, dict]], room_frames: tuple[object, list[WorldFrame]]
) -> None:
    frames = room_frames[1]
    closed, _ = close("never")
    refined, figures = close("always")
    assert figures["loops"] >= 1
    assert figures["joint"] == "kept"
    open_loop, before, after = (
        depth_error(run, stage, frames)
        for run, stage in ((closed, "mapping"), (closed, "global_ba"), (refined, "global_ba"))
    )
    assert before < 0.75 * open_loop
    assert after < before
    # The depths that it was refined by are in the world that the loop has made: one scale for both halves.
    scales = {i: np.median(refined.load(DEPTH_FIELDS, "global_ba").scales(i, 6, 8)) for i in range(0, 24, 2)}
    late, early = (np.median([s for i, s in scales.items() if (i >= FIRST_AGAIN) == x]) for x in (True, False))
    assert 0 < abs(late / early - 1) < 0.25 * (GROWTH - 1)
