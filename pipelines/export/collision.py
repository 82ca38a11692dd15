"""The mesh to walk in: few triangles, and a floor without holes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ...formats.glb import Part, write_primitive
from ..outcome import Outcome
from ..scene.world import World
from .atlas import simplified
from .mesh import mesh_of_run

COLLISION = "collision.glb"
MOST_FACES = 20_000
"""Triangles that physics engines on the web and on phones take."""


def write_collision(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """collision.glb of an outcome in the run's own world, for files in `world`: no colours, y up.

    Raises InputError where the run has no mesh, or an empty one.
    """
    mesh = mesh_of_run(outcome, world)
    light = simplified(mesh, MOST_FACES / len(mesh.faces)) if len(mesh.faces) > MOST_FACES else mesh
    points = light.vertices.astype(np.float64)
    faces = light.faces
    if world.axes == "up" and world.has_floor:
        points, faces = with_floor(points, faces)
    parts = [Part.of("POSITION", points @ world.gltf_from_exported.T), Part.of("", faces.astype(np.uint32).ravel())]
    write_primitive(folder / COLLISION, parts, {"mode": 4}, (), {"name": "collision"})
    return [folder / COLLISION]


def with_floor(points: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The mesh (V, 3), (F, 3) with z up, and a floor at z = 0, seen from above, under everything; without one where the
    mesh is a line from above."""
    try:
        rim = points[ConvexHull(points[:, :2]).vertices, :2]  # counterclockwise
    except QhullError:
        return points, faces
    n, start = len(rim), len(points)
    fan = start + np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    floor = np.column_stack([rim, np.zeros(n)])
    return np.concatenate([points, floor]), np.concatenate([faces, fan]).astype(np.int32)
