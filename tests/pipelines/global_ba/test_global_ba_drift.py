"""A loop that has grown by an eighth: closed, map and poses refined together; the pose graph shrugs off a lie."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.evaluation.metrics import DepthErrorSum
from msgs_slam.pipelines.evaluation.views import view_map
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.global_ba.close import Edges, apply_step, optimise_pose_graph, residuals
from msgs_slam.pipelines.global_ba.stage import run as run_global_ba
from msgs_slam.pipelines.run.files import (
    CALIBRATION,
    DEPTH_FIELDS,
    MAP,
    TRAJECTORY,
)
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from tests.pipelines.global_ba.test_global_ba_stage import FIRST_AGAIN, finish_mapping
from tests.pipelines.tracking.conftest import MadeRun, make_run, open_stage, room_frames
from tests.world.clip import WorldFrame

__all__ = ["make_run", "open_stage", "room_frames"]
Array = NDArray[np.float64]
GROWTH = 1.12
SETTINGS = ["mapping.max_side=128"]


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
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.loops.MIN_ALIKE", -1.0)
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.loops.GAP", 2)

    def run(joint: str) -> tuple[RunFolder, dict]:
        made = make_run(tmp_path / joint, keyframes=tuple(range(0, 24, 2)), backbone_scale=1.0, metric=False)
        center = se3.inverse(made.cam_from_world)[FIRST_AGAIN, :3, 3]
        finish_mapping(made, room_frames[1], Similarity(GROWTH, np.eye(3), (1 - GROWTH) * center))
        monkeypatch.setattr("msgs_slam.pipelines.global_ba.stage.JOINT_PX", 0.0 if joint == "always" else np.inf)
        context = open_stage(made.run, "global_ba", load_config(overrides=SETTINGS))
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


def random_nodes(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    poses = se3.exp(np.cumsum(rng.normal(size=(count, 6)) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1], axis=0))
    return poses, np.exp(np.cumsum(rng.normal(size=count) * 0.05))


def true_edges(poses: Array, scales: Array, pairs: list[tuple[int, int]], robust_from: int) -> Edges:
    """Edges that the nodes satisfy exactly."""
    first, second = (np.array(x) for x in zip(*pairs, strict=True))
    ratio = scales[second] / scales[first]
    motions = np.tile(np.eye(4), (len(pairs), 1, 1))
    motions[:, :3, :3] = poses[second, :3, :3] @ np.swapaxes(poses[first, :3, :3], 1, 2)
    turned = np.einsum("eij,ej->ei", motions[:, :3, :3], poses[first, :3, 3])
    motions[:, :3, 3] = poses[second, :3, 3] - ratio[:, None] * turned
    sd = np.tile([0.01] * 3 + [0.005] * 3 + [0.01], (len(pairs), 1))
    return Edges(first, second, motions, ratio, sd, np.arange(len(pairs)) >= robust_from)


def chain(count: int) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(count - 1)]


def test_truth_has_no_residual_and_is_found_again() -> None:
    rng = np.random.default_rng(0)
    poses, scales = random_nodes(rng, 20)
    edges = true_edges(poses, scales, [*chain(20), (0, 19), (3, 15)], 19)
    assert np.abs(residuals(poses, scales, edges)).max() < 1e-9
    step = rng.normal(size=(20, 7)) * 0.05
    step[0] = 0
    found, found_scales = optimise_pose_graph(*apply_step(poses, scales, step), edges)
    assert np.allclose(found, poses, atol=1e-5)
    assert np.allclose(found_scales, scales, atol=1e-5)


def test_a_loop_spreads_its_correction() -> None:
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = np.arange(11)
    scales = np.ones(11)
    exact = true_edges(poses, scales, [*chain(11), (0, 10)], 11)
    motions = exact.second_from_first.copy()
    motions[-1, 0, 3] -= 0.05
    edges = Edges(exact.first, exact.second, motions, exact.scale, exact.sd, exact.robust)
    found, _ = optimise_pose_graph(poses, scales, edges)
    steps = np.diff(found[:, 0, 3])
    assert np.allclose(found[0], np.eye(4))
    assert 0.02 < 10 - found[10, 0, 3] < 0.05
    # No single step takes half of it.
    assert np.abs(steps - 1).max() < 0.025


def test_one_false_loop_among_good_ones_loses_its_pull() -> None:
    rng = np.random.default_rng(1)
    poses, scales = random_nodes(rng, 20)
    good = true_edges(poses, scales, [*chain(20), (0, 19), (1, 18), (2, 17), (5, 12)], 19)
    motions = good.second_from_first.copy()
    motions[-1, :3, 3] += 2.0
    found, _ = optimise_pose_graph(
        poses, scales, Edges(good.first, good.second, motions, good.scale, good.sd, good.robust)
    )
    believed = Edges(good.first, good.second, motions, good.scale, good.sd, np.zeros_like(good.robust))
    pulled, _ = optimise_pose_graph(poses, scales, believed)
    moved, dragged = (np.linalg.norm(x[:, :3, 3] - poses[:, :3, 3], axis=1).max() for x in (found, pulled))
    assert moved < 0.05 < 0.2 < dragged
