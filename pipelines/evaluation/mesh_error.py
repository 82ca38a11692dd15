"""Accuracy and completeness of the exported mesh against the surface that the true depth shows."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry import se3
from ..geometry.camera import project, unproject_depth
from ..outcome import Outcome
from ..run.files import MESH
from ..scene.world import FIRST, WORLD
from ..types import Intrinsics
from .truth import AbsoluteError, MatchedTruth

SAMPLES = 200_000
VIEWS = 60
SLACK = 0.1
"""Metres that a point of the mesh may lie behind the true surface and still count as one the camera should see."""
CELL = 0.02

Points = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceError:
    """accuracy: mean distance from the mesh to the truth; completeness: from the truth to the mesh, both in metres.
    precision, recall: shares of these distances below `threshold`; f_score their harmonic mean."""

    accuracy: float
    completeness: float
    precision: float
    recall: float
    f_score: float
    threshold: float


def sample_surface(vertices: NDArray, faces: NDArray, count: int, seed: int = 0) -> Points:
    """(count, 3) points spread evenly by area over a triangle mesh. Raises ValueError for a mesh without area."""
    corners = vertices[faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    if not areas.sum() > 0:
        raise ValueError("the mesh has no area")
    rng = np.random.default_rng(seed)
    # Stratified: one draw in each of `count` equal shares of the area.
    at = (np.arange(count) + rng.random(count)) / count * areas.sum()
    chosen = np.clip(np.searchsorted(np.cumsum(areas), at), 0, len(areas) - 1)
    a, b = rng.random((2, count))
    over = a + b > 1
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    first, second, third = corners[chosen].transpose(1, 0, 2)
    return first + a[:, None] * (second - first) + b[:, None] * (third - first)


def surface_error(points: Points, true_points: Points, threshold: float = 0.05) -> SurfaceError:
    """Errors between two sampled surfaces (N, 3) and (M, 3) in metres. Raises ValueError where one is empty."""
    if len(points) == 0 or len(true_points) == 0:
        raise ValueError(f"nothing to compare: {len(points)} points against {len(true_points)}")
    to_truth = cKDTree(true_points).query(points)[0]
    to_mesh = cKDTree(points).query(true_points)[0]
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    f_score = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return SurfaceError(float(to_truth.mean()), float(to_mesh.mean()), precision, recall, f_score, threshold)


def thinned(points: Points, cell: float) -> Points:
    """One point of every cell of a grid of `cell` metres: the first in the order of the cells."""
    if len(points) == 0:
        return points
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    # One number a cell sorts twenty times faster than three.
    number = np.ravel_multi_index(tuple(cells.T), tuple((cells.max(axis=0) + 1).tolist()))
    return points[np.unique(number, return_index=True)[1]]


def depth_points(depth: NDArray, camera: Intrinsics, world_from_cam: NDArray[np.float64], stride: int = 1) -> Points:
    """(P, 3) world points of every `stride`-th pixel with a depth."""
    points = unproject_depth(depth, camera)[::stride, ::stride]
    return se3.transform(world_from_cam, points[depth[::stride, ::stride] > 0])


def seen_in_depth(
    points: Points, depth: NDArray, camera: Intrinsics, cam_from_world: NDArray[np.float64], slack: float
) -> NDArray[np.bool_]:
    """(N,) whether a point lies in the image and no further than `slack` metres behind the depth seen there."""
    xy, z = project(se3.transform(cam_from_world, points), camera)
    # Pixels of points behind the camera are NaN, which compares false.
    seen = np.asarray(((xy >= 0) & (xy < (camera.width, camera.height))).all(axis=1))
    column, row = xy[seen].astype(np.int64).T
    seen[seen] = (depth[row, column] > 0) & (z[seen] < depth[row, column] + slack)
    return seen


def mesh_cells(outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None) -> dict[str, Any]:
    """Accuracy, completeness and F-score, or why not."""
    if not outcome.run.has("export", MESH):
        return {"missing": "no mesh was exported"}
    if not matched.sequence.metric:
        return {"missing": "the truth's poses have no metric scale, its depth has"}
    if alignment is None:
        return {"missing": "the poses could not be aligned with the truth"}
    truth, views = true_surface(matched)
    if len(truth) == 0:
        return {"missing": "the truth has no depth, or no camera for it"}
    mesh = _load_mesh(outcome.run.file("export", MESH))
    if mesh is None:
        return {"missing": "the mesh is empty"}
    world = outcome.run.find(WORLD) or FIRST
    points = sample_surface(*mesh, SAMPLES)
    points = alignment.alignment.apply(world.exported_from_run.inverse().apply(points))
    points = points[_seen_by_any(points, views)]
    if len(points) == 0:
        return {"missing": "no camera with true depth sees the mesh"}
    return {**asdict(surface_error(points, truth)), "points": len(points), "true points": len(truth)}


def _load_mesh(path: Path) -> tuple[NDArray, NDArray] | None:
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
        points.append(depth_points(depth, camera, pose, stride=max(1, max(depth.shape) // 320)))
        views.append((depth, camera, np.linalg.inv(pose)))
    return (thinned(np.concatenate(points), CELL) if points else np.zeros((0, 3))), views


def _seen_by_any(points: NDArray[np.float64], views: list[_SeenView]) -> NDArray[np.bool_]:
    seen = np.zeros(len(points), dtype=bool)
    for depth, camera, cam_from_world in views:
        left = np.flatnonzero(~seen)
        seen[left] = seen_in_depth(points[left], depth, camera, cam_from_world, SLACK)
    return seen
