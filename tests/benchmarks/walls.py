"""Lengths of walls in a run's mesh beside those in surfaces made of true depth."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.export.floor_plan import walls_of_run
from msgs_slam.pipelines.export.walls import Wall, find_walls
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD

STEP, VIEWS, JUMP = 4, 30, 1.06
"""Every so many pixels, of so many views; a depth that many times another's lies on another surface."""


def true_walls(truth: Dataset, exported_from_truth: Similarity) -> list[Wall]:
    """Walls of the surfaces that the data set's depth shows."""
    camera, vertices, faces, count = truth.camera, [], [], 0
    assert camera is not None
    assert truth.world_from_cam is not None
    for i in range(0, len(truth.names), max(1, len(truth.names) // VIEWS)):
        depth = truth.depth(i)
        assert depth is not None
        v, u = np.mgrid[0 : depth.shape[0] : STEP, 0 : depth.shape[1] : STEP]
        d = depth[::STEP, ::STEP]
        seen = np.stack([(u - camera.cx) / camera.fx * d, (v - camera.cy) / camera.fy * d, d], axis=-1).reshape(-1, 3)
        pose = truth.world_from_cam[i]
        vertices.append(exported_from_truth.apply(seen @ pose[:3, :3].T + pose[:3, 3]))
        faces.append(count + grid_faces(d))
        count += d.size
    return find_walls(np.concatenate(vertices), np.concatenate(faces))


def grid_faces(depth: NDArray) -> NDArray[np.int64]:
    """(F, 3) of an image's pixels, facing the camera; none where depth is missing or jumps."""
    ids = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (part.ravel() for part in (ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    corners = depth.ravel()[faces]
    return faces[(corners.min(axis=1) > 0) & (corners.max(axis=1) < JUMP * corners.min(axis=1))]


def main() -> None:
    """Both lists of walls, in metres of the data set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("dataset", type=Path)
    arguments = parser.parse_args()
    run, truth = RunFolder(arguments.run), open_sequence(arguments.dataset)
    outcome, world = load_outcome(run, "cpu"), run.find(WORLD)
    assert world is not None
    t, matched = outcome.moved(world.exported_from_run).trajectory, match_truth(outcome.frames, False, truth)
    rows = np.flatnonzero(t.is_posed & matched.has_pose)
    move = align_points(matched.world_from_cam[rows, :3, 3], t.centers[rows])
    for name, walls in (("true", true_walls(truth, move)), ("found", walls_of_run(run))):
        for wall in walls:
            told = ", not whole" if not wall.is_whole else f" ± {wall.blur / move.scale:.2f}"
            ends = ", ".join(f"{v:.2f}" for v in wall.ends.ravel())
            print(f"{name}: {wall.length / move.scale:.3f} m{told} ({ends})")


if __name__ == "__main__":
    main()
