"""Up and the floor against the truth of the synthetic room, whose z is up; and scenes that do not tell."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from finished import note_finished
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Dataset
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export.stage import export_run, find_world
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.files import MAP
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import (
    FIRST,
    WORLD,
    World,
    common_direction,
    find_upright,
    line_planes,
    upright_world,
)
from msgs_slam.pipelines.types import Intrinsics

OracleRun = Callable[..., RunFolder]
MOVE = Similarity(1.0, Rotation.from_euler("xyz", [130, 25, -50], degrees=True).as_matrix(), np.array([3.0, -2, 5]))
UP = np.array([0.0, 0, 1])


def degrees(a: NDArray, b: NDArray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.fixture(scope="module")
def run(oracle_run: OracleRun) -> RunFolder:
    return oracle_run(world_from_truth=MOVE)


def test_the_room_stands_upright_on_its_floor(run: RunFolder, truth: Dataset) -> None:
    outcome = load_outcome(run)
    found = find_upright(outcome)
    assert found.source == "floor and upright lines"
    assert 0 < degrees(found.up, MOVE.rotation @ UP) < 1
    assert max(found.disagreement_deg["upright lines"], found.disagreement_deg["floor"]) < 1
    world = upright_world(outcome, found)
    exported_from_truth = world.exported_from_run @ MOVE
    assert abs(exported_from_truth.apply(np.zeros(3))[2]) < 0.03, "the floor of the room is at z = 0"
    centers = exported_from_truth.apply(truth.world_from_cam[:, :3, 3])
    np.testing.assert_allclose(centers.mean(axis=0)[:2], 0, atol=1e-9)
    # y is where the first camera looks, x to its right.
    first = exported_from_truth.rotation @ truth.world_from_cam[0, :3, :3]
    assert first[1, 2] > 0.9
    assert first[0, 0] > 0.99


def test_lines_alone_tell_up(run: RunFolder) -> None:
    rng = np.random.default_rng(0)
    up = Rotation.from_rotvec([0.1, 0.15, 0]).apply(UP)
    directions = np.concatenate([np.tile(up, (120, 1)), rng.normal(size=(400, 3))])
    normals = np.cross(directions, rng.normal(size=directions.shape))
    normals += 0.003 * rng.normal(size=normals.shape) * np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = common_direction(normals, rng.uniform(0.05, 0.3, len(normals)), UP)
    assert found.is_sure
    assert 0 < degrees(found.up, up) < 0.3


def test_chance_does_not_tell_up() -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(800, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert not common_direction(normals, np.ones(800), UP).is_sure
    assert not common_direction(np.zeros((0, 3)), np.zeros(0), UP).is_sure


def test_a_line_in_a_picture_is_a_plane_through_the_camera() -> None:
    camera = Intrinsics(400, 300, 350.0, 360.0, 190.0, 160.0)
    picture = np.full((300, 400, 3), 255, np.uint8)
    cv2.fillPoly(picture, [np.array([[100, 40], [300, 60], [300, 400], [100, 400]])], (0, 0, 0))
    normals, lengths = line_planes(picture, camera)
    rays = [np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1]) for x, y in ((100, 40), (300, 60))]
    true = np.cross(*rays) / np.linalg.norm(np.cross(*rays))
    best = np.abs(normals @ true).argmax()
    assert degrees(normals[best] * np.sign(normals[best] @ true), true) < 0.2
    assert lengths[best] == pytest.approx(0.5, abs=0.05)


@pytest.fixture(scope="module")
def shapeless(oracle_run: OracleRun) -> RunFolder:
    """Pictures of noise, and a map without a level surface."""
    run = oracle_run(world_from_truth=MOVE)
    rng = np.random.default_rng(2)
    outcome = load_outcome(run)
    for frame in outcome.frames:
        write_rgb(run.stage("frames") / frame.name, rng.integers(0, 255, (120, 160, 3), np.uint8))
    m = outcome.require_map()
    center = m.means.mean(0)
    ball = torch.nn.functional.normalize(torch.randn(len(m), 3, generator=torch.Generator().manual_seed(0)), dim=1)
    MAP.save(run.stage("mapping"), type(m)(**{**vars(m), "means": center + 0.7 * ball}))
    note_finished(run, ("frames", "proxy", "tracking", "mapping"))
    return run


def test_a_scene_that_does_not_tell_stays_as_it_was(shapeless: RunFolder, tmp_path: Path) -> None:
    outcome = load_outcome(shapeless)
    world, reasons = find_world(outcome, ExportConfig())
    assert world == FIRST
    assert "up is unknown" in reasons[0]
    assert tmp_path / "world.json" in export_run(shapeless, tmp_path, "tum")
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(rows[:, 1:4], outcome.trajectory.centers, atol=1e-6)


def test_first_axes_on_request(run: RunFolder) -> None:
    assert find_world(load_outcome(run), ExportConfig(axes="first")) == (FIRST, [])


def test_world_file_round_trip(run: RunFolder) -> None:
    world = World("up", "floor", True, MOVE, {"cameras": 1.5})
    read = WORLD.read(WORLD.save(run.root, world))
    assert (read.axes, read.source, read.has_floor, read.disagreement_deg) == ("up", "floor", True, {"cameras": 1.5})
    np.testing.assert_array_equal(read.exported_from_run.rotation, MOVE.rotation)
    assert run.find(WORLD) is None, "nothing is exported yet"
    (run.root / "world.json").write_text('{"axes": "up", "exported_from_run": 3}')
    with pytest.raises(InputError, match="world"):
        WORLD.read(run.root / "world.json")
