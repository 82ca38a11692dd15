"""The exported mesh against the surface that the true depth shows."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..outcome import Outcome
from ..run.files import MESH
from ..scene.world import FIRST, WORLD
from ..types import Intrinsics
from .surface_error import (
    depth_points,
    sample_surface,
    seen_in_depth,
    surface_error,
    thinned,
)
from .trajectory_error import AbsoluteError
from .truth import MatchedTruth

SAMPLES = 200_000
VIEWS = 60
SLACK = 0.1
"""Metres that a point of the mesh may lie behind the true surface and still count as one the camera should see."""
CELL = 0.02


def mesh_cells(outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None) -> dict[str, Any]:
    """Accuracy, completeness and F-score, or why not."""
    if not outcome.run.has("export", MESH):
        return {"missing": "no mesh was exported"}
    if alignment is None:
        return {"missing": "the poses could not be aligned with the truth"}
    truth, views = true_surface(matched)
    if len(truth) == 0:
        return {"missing": "the truth has no depth, or no camera for it"}
    mesh = _load(outcome.run.file("export", MESH))
    if mesh is None:
        return {"missing": "the mesh is empty"}
    world = outcome.run.find(WORLD) or FIRST
    points = sample_surface(*mesh, SAMPLES)
    points = alignment.alignment.apply(world.exported_from_run.inverse().apply(points))
    points = points[_seen(points, views)]
    if len(points) == 0:
        return {"missing": "no camera with true depth sees the mesh"}
    return {**asdict(surface_error(points, truth)), "points": len(points), "true points": len(truth)}


def _load(path: Path) -> tuple[NDArray, NDArray] | None:
    mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not mesh.area > 0:
        return None
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


_SeenView = tuple[NDArray[np.float32], Intrinsics, NDArray[np.float64]]


def true_surface(matched: MatchedTruth) -> tuple[NDArray[np.float64], list[_SeenView]]:
    """Points of the true depth of up to `VIEWS` frames, thinned; and (depth, camera, cam_from_world) of each.

    A lens with distortion is left out: its depth does not follow the pinhole that the points are made with.
    """
    sequence = matched.sequence
    if sequence.camera is None or sequence.camera.is_distorted or not sequence.has_depth:
        return np.zeros((0, 3)), []
    rows = np.flatnonzero(matched.has_pose & (matched.image >= 0))
    points, views = [], []
    for row in rows[np.unique(np.linspace(0, len(rows) - 1, VIEWS).astype(int))] if len(rows) else ():
        depth = sequence.depth(int(matched.image[row]))
        if depth is None:
            continue
        k = sequence.camera.resized(depth.shape[1], depth.shape[0])
        camera = Intrinsics(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
        pose = matched.world_from_cam[row]
        points.append(depth_points(depth, camera, pose, stride=max(1, depth.shape[1] // 320)))
        views.append((depth, camera, np.linalg.inv(pose)))
    return (thinned(np.concatenate(points), CELL) if points else np.zeros((0, 3))), views


def _seen(points: NDArray[np.float64], views: list[_SeenView]) -> NDArray[np.bool_]:
    seen = np.zeros(len(points), dtype=bool)
    for depth, camera, cam_from_world in views:
        left = np.flatnonzero(~seen)
        seen[left] = seen_in_depth(points[left], depth, camera, cam_from_world, SLACK)
    return seen
