"""The mesh to walk in: light, closed below, and in the axes of glTF."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from finished import note_finished
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.export.meshes import MAX_FACES, with_floor
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.scene.world import SAME, WORLD, World

OracleRun = Callable[..., RunFolder]


def test_nobody_falls_through_the_floor(oracle_run: OracleRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no mesh yet"):
        export_run(oracle_run(), tmp_path / "none", "collision")
    assert not (tmp_path / "none").exists()
    run = oracle_run(mesh=True)
    room = trimesh.creation.box((6, 4, 2.5)).subdivide_to_size(0.06)
    room.update_faces(room.triangles_center[:, 2] > -1.2)  # no floor
    room.apply_translation((0, 0, 1.25))
    room.invert()
    room.visual.vertex_colors = np.full((len(room.vertices), 4), 200, np.uint8)
    assert len(room.faces) > MAX_FACES
    room.export(run.stage("export") / "mesh.ply")
    WORLD.save(run.stage("export"), World("up", "floor", True, SAME))
    note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"))
    path = export_run(run, tmp_path, "collision")[0]
    light = trimesh.load(path, force="mesh")
    assert 100 < len(light.faces) <= MAX_FACES + 100
    np.testing.assert_allclose(light.bounds, [[-3, 0, -2], [3, 2.5, 2]], atol=0.02)  # y up
    for x, z in np.random.default_rng(0).uniform((-2.9, -1.9), (2.9, 1.9), (50, 2)):
        heights = crossed(light.triangles, x, z)
        assert abs(heights).min() < 0.02  # the floor
        assert abs(heights - 2.5).min() < 0.02  # the ceiling


def crossed(triangles: NDArray, x: float, z: float) -> NDArray:
    """Heights at which the upright line through a place crosses triangles (F, 3, 3) with y up."""
    a, b, c = (triangles[:, k][:, [0, 2]] for k in range(3))
    u, v, w = b - a, c - a, np.array([x, z]) - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    flat = np.abs(area) > 1e-12
    s, t = (np.zeros(len(a)) for _ in range(2))
    s[flat] = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0])[flat] / area[flat]
    t[flat] = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])[flat] / area[flat]
    inside = flat & (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
    heights = triangles[..., 1]
    return (heights[:, 0] + s * (heights[:, 1] - heights[:, 0]) + t * (heights[:, 2] - heights[:, 0]))[inside]


def test_the_floor_is_seen_from_above() -> None:
    points = np.array([[0.0, 0, 1], [4, 0, 1], [4, 3, 1], [0, 3, 1], [2, 1, 2]])
    more, faces = with_floor(points, np.zeros((0, 3), np.int32))
    corners = more[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (across[:, 2] > 0).all()
    assert across[:, 2].sum() / 2 == pytest.approx(12)
    assert not corners[..., 2].any()
