"""Depths that are not sure, beside planes, steps and curves that are: a made room, 60 voxels deep."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.export.mesh import draw_keyframes, keyframe_rows, mesh_views, planes_in, snap_views
from msgs_slam.pipelines.export.planes import Planes, find_planes, planes_of, put_planes, snap_to_planes
from msgs_slam.pipelines.export.surface import chunk_surfaces, weld
from msgs_slam.pipelines.export.volume import CHUNK, fuse, make_grid
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.geometry.voxels import Voxels
from msgs_slam.pipelines.mapping.measure import MeshView
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.stages import StageContext, in_chunks
from msgs_slam.pipelines.scene.world import SAME
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.types import Intrinsics

Image = NDArray[np.float64]
OracleRun = Callable[..., RunFolder]
CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
WALL, FLOOR = 3.0, 1.0
VOXEL = WALL / 60
ROWS, COLUMNS = np.mgrid[:120, :160] + 0.5
RAYS = np.stack([(COLUMNS - 80) / 150, (ROWS - 60) / 150, np.ones_like(ROWS)], -1)
MIDDLE = (np.abs(COLUMNS - 80) < 35) & (np.abs(ROWS - 50) < 25)
WAVES = np.sin(COLUMNS / 12) * np.sin(ROWS / 12)


def room() -> Image:
    """Depth of a wall 3 away and a floor 1 below the camera."""
    return np.minimum(WALL, FLOOR / np.maximum(RAYS[..., 1], 1e-9))


def view(depth: Image, unsure: NDArray[np.bool_], aside: float) -> MeshView:
    """From a camera `aside` to the right; what is seen moves with it."""
    pose = np.eye(4)
    pose[0, 3] = -aside
    shown = PosedDepth(CAMERA, pose, depth.astype(np.float32), np.ones(depth.shape, np.float32))
    return MeshView(shown, np.zeros((*depth.shape, 3), np.uint8), None, unsure)


def views(depth: Image, unsure: NDArray[np.bool_]) -> list[MeshView]:
    return [view(depth, unsure, aside) for aside in (-0.1, 0.0, 0.1)]


def test_an_unsure_wall_becomes_straight() -> None:
    truth = room()
    seen = views(truth + 1.8 * VOXEL * WAVES * MIDDLE, MIDDLE)
    planes = planes_of(seen)
    assert sorted(np.round(planes.normal, 2).tolist()) == [[0, -1, 0], [0, 0, -1]]
    before, after = (np.abs(v.shown.depth - truth)[MIDDLE] for v in (seen[0], snap_to_planes(seen[0], planes)))
    assert np.percentile(before, 90) > VOXEL
    assert np.percentile(after, 90) < 0.1 * VOXEL


def test_a_step_of_four_voxels_stays() -> None:
    depth = room() - 4 * VOXEL * MIDDLE
    seen = views(depth, MIDDLE)
    planes = planes_of(seen)
    assert len(planes.offset) == 2
    np.testing.assert_array_equal(snap_to_planes(seen[1], planes).shown.depth, seen[1].shown.depth)


def test_a_plane_ends_where_others_are_sure_of_something_else() -> None:
    """One view in three does not know of a panel two voxels before the wall, on which no plane was found."""
    depth = room() - 2 * VOXEL * MIDDLE
    seen = views(depth, np.zeros_like(MIDDLE))
    seen[0] = replace(seen[0], unsure=MIDDLE)
    moved = np.abs(snap_to_planes(seen[0], planes_of(seen)).shown.depth - depth)
    inner = (np.abs(COLUMNS - 80) < 14) & (np.abs(ROWS - 50) < 8)
    assert moved[inner].max() < 0.1 * VOXEL


def test_a_ball_stays() -> None:
    """Of eight voxels radius, before the wall."""
    center = np.array([0.0, -0.1, 2.0])
    a, b, c = (RAYS**2).sum(-1), RAYS @ center, center @ center - (8 * VOXEL) ** 2
    ball = b**2 > a * c
    depth = np.where(ball, (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a, room())
    seen = [view(depth, ball, 0.0)] * 3
    np.testing.assert_array_equal(snap_to_planes(seen[0], planes_of(seen)).shown.depth, seen[0].shown.depth)


def test_a_round_hall_gets_facets_of_less_than_two_voxels() -> None:
    """A sphere of forty voxels radius from inside, every other four columns unsure."""
    depth = 40 * VOXEL / np.sqrt((RAYS**2).sum(-1))
    seen = [view(depth, COLUMNS.astype(int) % 8 < 4, 0.0)] * 3
    off = np.abs(snap_to_planes(seen[1], planes_of(seen)).shown.depth - depth)
    assert off.max() < 2 * VOXEL


def test_planes_are_the_same_every_time_and_travel(tmp_path: Path) -> None:
    seen = views(room(), MIDDLE)
    first = planes_of(seen)
    save_value(tmp_path / "planes.npz", first)
    for other in (planes_of(seen), load_value(tmp_path / "planes.npz")):
        np.testing.assert_array_equal(other.normal, first.normal)
        np.testing.assert_array_equal(other.offset, first.offset)
        assert [c.tolist() for c in other.cubes] == [c.tolist() for c in first.cubes]


@pytest.mark.parametrize("count", [0, 20])
def test_no_surface_has_no_planes(count: int) -> None:
    some = np.ones((count, 3))
    found = find_planes(Voxels(1.0, np.arange(count), np.ones(count), some, some / 3**0.5, some))
    assert found.normal.shape == (0, 3)
    assert isinstance(planes_of([]), Planes)


def test_views_of_a_run_are_made_straight_once(oracle_run: OracleRun, tmp_path: Path) -> None:
    run = oracle_run(video=True)
    count = len(keyframe_rows(load_outcome(run)))

    def context(planes: str) -> StageContext:
        config = Config(export=ExportConfig(planes=planes))
        (folder := tmp_path / planes).mkdir(exist_ok=True)
        return StageContext(run, run.root, config, folder, SilentProgress())

    for planes in ("off", "straight"):
        in_chunks(context(planes), draw_keyframes, count, move=SAME)
        scratch = context(planes).snapshot / "mesh"
        assert (mesh_views(scratch, count)[0].unsure is not None) == (planes != "off")
    found = []
    for _ in range(2):
        in_chunks(context(planes), snap_views, count, planes=planes_in(scratch, count))
        found.append({path: path.read_bytes() for path in scratch.glob("*.npz")})
    assert all(v.unsure is None for v in mesh_views(scratch, count))
    assert found[0] == found[1]


def test_the_floor_goes_on_under_what_hides_it_and_not_beyond_what_is_seen() -> None:
    """Behind a box on the floor, which is seen on both sides and in front of it; a wall closes the room."""
    low = 0.5
    box = (np.abs(RAYS[..., 0] * 2) < 0.3) & (RAYS[..., 1] * 2 > 0.25) & (RAYS[..., 1] * 2 < low)
    depth = np.where(box, 2.0, np.minimum(WALL, low / np.maximum(RAYS[..., 1], 1e-9)))
    seen = views(depth, np.zeros_like(MIDDLE))
    planes = planes_of(seen)
    floor = int(np.argmin(planes.normal[:, 1]))

    def goes_on(x: float, z: float) -> bool:
        return bool(np.isin(planes.keys(floor, np.array([[x, low, z]])), planes.squares[floor])[0])

    assert goes_on(0.0, 2.5)  # behind the box, where no view sees it
    assert not goes_on(0.0, 3.6)  # behind the wall
    assert not goes_on(2.5, 2.6)  # beside all views
    shown = [view.shown for view in seen]
    found = []
    for more in ((), (planes.points,)):
        grid = make_grid(shown, VOXEL / 2, 3.0, 100_000, *more)
        chunks = np.unique(grid.blocks // CHUNK, axis=0)
        volume = fuse(grid, chunks, shown)
        if more:
            put_planes(volume, planes, grid.truncation, 0.5)
        points = weld(chunk_surfaces(volume, chunks, 0.5), chunks, grid.voxel).vertices
        under = (np.abs(points[:, 0]) < 0.2) & (np.abs(points[:, 2] - 2.5) < 0.15) & (points[:, 1] > 0.4)
        found.append(points[under])
    assert len(found[0]) == 0
    assert len(found[1]) > 20
    np.testing.assert_allclose(found[1][:, 1], low, atol=0.2 * VOXEL)
