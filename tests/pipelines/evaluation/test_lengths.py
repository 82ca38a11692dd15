"""Lengths in the report against the truth of the made-up room, and in the words of the tape."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from finished import note_finished
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Dataset
from msgs_slam.pipelines.evaluation.facts import (
    extents,
    found_lengths,
    length_text,
    measured_camera_height,
    path_length,
)
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD, World
from msgs_slam.pipelines.types import Metres
from tests.world.room import HEIGHT, LENGTH, WIDTH

OracleRun = Callable[..., RunFolder]
TURNED = Similarity(0.5, np.array([[0.8, -0.6, 0], [0, 0, -1], [0.6, 0.8, 0]]), np.array([0.3, -1.0, 2.0]))


def _exported(run: RunFolder, move: Similarity, floor: bool = True) -> RunFolder:
    (run.stage("export")).mkdir(exist_ok=True)
    WORLD.save(run.stage("export"), World("up", "floor", floor, move))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    return run


def test_lengths_of_the_made_up_room(oracle_run: OracleRun, truth: Dataset) -> None:
    outcome = load_outcome(oracle_run())
    centers = truth.world_from_cam[:, :3, 3]
    length = path_length(outcome)
    assert length[0] == pytest.approx(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum(), rel=1e-3)
    assert 0 < length[1] < 0.02
    assert measured_camera_height(outcome)[0] == pytest.approx(np.median(centers[:, 2]), abs=1e-3)
    (long, _), (wide, _), (high, _) = extents(outcome)
    assert long == pytest.approx(LENGTH, rel=0.02)
    assert 0.8 * WIDTH < wide < WIDTH  # half a lap does not see the walls on its own side
    assert high < HEIGHT


def test_a_turned_box_with_floaters_about_it_has_its_own_size(oracle_run: OracleRun) -> None:
    outcome, rng, sides = load_outcome(oracle_run()), np.random.default_rng(0), np.array([6.0, 3.0, 2.5])
    gaussians = outcome.require_map()
    points = rng.uniform(-0.5, 0.5, (len(gaussians), 3)) * sides
    face = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), face] = rng.choice([-0.5, 0.5], len(points)) * sides[face]
    points[::300] *= 4
    turn = Rotation.from_euler("z", 25, degrees=True).as_matrix()
    box = replace(gaussians, means=torch.from_numpy((points @ turn.T + 7).astype(np.float32)))
    for (found, sd), true in zip(extents(replace(outcome, gaussian_map=box)), sides, strict=True):
        assert abs(found - true) < 0.02 * true
        assert 0 <= sd < 0.05 * true


def test_they_are_said_as_the_tape_says_them(oracle_run: OracleRun) -> None:
    run = _exported(oracle_run(TURNED.inverse(), metric=False), TURNED)
    outcome = load_outcome(run)
    rows = dict(found_lengths(outcome))
    assert list(rows)[:2] == ["length of the path", "camera height above the floor"]
    assert len(rows) == 5
    true = load_outcome(oracle_run())
    in_world = path_length(true)
    assert rows["length of the path"] == length_text(*in_world, False, None)
    known = replace(outcome, metres=Metres(0.5, 0.1, True, ("a table",)))
    assert dict(found_lengths(known))["length of the path"].endswith(" m")


def test_what_is_not_known_is_not_told(oracle_run: OracleRun) -> None:
    run = oracle_run()
    assert found_lengths(load_outcome(run)) == []
    rows = dict(found_lengths(load_outcome(_exported(run, TURNED, floor=False))))
    assert "camera height above the floor" not in rows
    t = run.load(TRAJECTORY, "tracking")
    lost = tuple("lost" if i > 3 else "" for i in range(len(t.lost_reasons)))
    few = load_outcome(run)
    assert path_length(replace(few, trajectory=replace(t, is_keyframe=t.frame_ids == 0, lost_reasons=lost))) is None


def test_a_length_is_stated_in_the_units_there_are() -> None:
    guess = Metres(2.0, 0.09, True, ("a door",))
    assert length_text(1.5, 0.03, True, None) == "1.500 ± 0.030 m"
    assert length_text(1.5, 0.03, False, None) == "1.500 ± 0.030 units"
    assert length_text(1.5, 0.03, False, guess) == "1.500 ± 0.030 units ≈ 3.00 ± 0.28 m"
    assert length_text(1.5, 0.03, True, Metres(1.0, 0.01, False, ("GPS",))) == "1.500 ± 0.034 m"
