"""Fusion of depth images of a sphere whose surface, colours and classes are known."""

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from ball import CAMERA, RADIUS, orbit, pixel_rays, see_ball, seen_points
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from msgs_slam.formats.ply import MeshArrays, read_mesh_ply, write_mesh_ply
from msgs_slam.pipelines.export.mesh import paint
from msgs_slam.pipelines.export.patches import patched
from msgs_slam.pipelines.export.surface import Region, Surface, Triangles, chunk_surfaces, closed, joined, weld
from msgs_slam.pipelines.export.volume import CHUNK, Grid, Volume, fuse, make_grid
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.mapping.measure import MeshView
from msgs_slam.pipelines.system.raster import draw_faces
from msgs_slam.pipelines.system.threads import get_threads, set_threads
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.types import VOID

VOXEL = 0.02


def painted(view: PosedDepth) -> MeshView:
    """Where x < 0 in the world channel 0 and red, else channel 1 and blue."""
    left = seen_points(view)[..., 0] < 0
    colors = np.where(left[..., None], [204, 0, 0], [0, 0, 204]).astype(np.uint8)
    return MeshView(view, colors, np.where(left, 0, 1).astype(np.int16))


class Corridor(Sequence[PosedDepth]):
    """Views along a corridor two metres wide and high, made as they are asked for."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> PosedDepth:  # type: ignore[override]
        if index >= self.count:
            raise IndexError
        pose = np.eye(4)
        pose[2, 3] = -0.5 * index
        rays = np.abs(pixel_rays()[..., :2]).max(-1)
        depth = np.minimum(1 / np.maximum(rays, 1e-9), 6).astype(np.float32)
        return PosedDepth(CAMERA, pose, depth, (depth < 5).astype(np.float32))


def fused(count: int = 24, max_blocks: int = 100_000) -> Volume:
    views = orbit(count)
    grid = make_grid(views, VOXEL, 4.0, max_blocks)
    return fuse(grid, all_chunks(grid), views)


def all_chunks(grid: Grid) -> NDArray[np.int32]:
    return np.unique(grid.blocks // CHUNK, axis=0)


def extracted(
    views: Sequence[PosedDepth], voxel: float, at_once: int, least: float = 1.5, closing: bool = True
) -> trimesh.Trimesh:
    """The surface, made region by region."""
    grid = make_grid(views, voxel, 4.0, 10_000_000)
    surfaces = [surface_of(grid, views, chunks, least, closing) for chunks in grid.regions(at_once)]
    return whole(surfaces, 0.0)


def surface_of(
    grid: Grid, views: Sequence[PosedDepth], chunks: NDArray[np.int32], least: float, closing: bool = True
) -> Surface:
    volume = fuse(grid, chunks, (views[n] for n in grid.views_of(chunks)))
    return closed(
        weld(chunk_surfaces(volume, chunks, least), chunks, grid.voxel), views if closing else [], 3 * grid.truncation
    )


def whole(surfaces: Sequence[Surface], least_share: float) -> trimesh.Trimesh:
    """The regions joined; each vertex has its region as label and its row there as colour."""
    rows = [np.stack([np.arange(len(s.vertices)) >> bits & 255 for bits in (0, 8, 16)], 1) for s in surfaces]
    labels = [np.full(len(s.vertices), n, np.uint8) for n, s in enumerate(surfaces)]
    regions = [Region(s, r.astype(np.uint8), n) for s, r, n in zip(surfaces, rows, labels, strict=True)]
    blocks = joined(lambda: regions, least_share)
    for points, colors, numbers in blocks.vertices():
        own = surfaces[numbers[0]].vertices[colors @ np.array([1, 256, 65536])] if len(points) else points
        np.testing.assert_array_equal(points, own)
    points = np.concatenate([np.zeros((0, 3), np.float32), *(points for points, _, _ in blocks.vertices())])
    faces = np.concatenate([np.zeros((0, 3), np.int32), *blocks.faces()])
    assert (blocks.vertex_count, blocks.face_count) == (len(points), len(faces))
    return trimesh.Trimesh(points, faces, process=False)


@pytest.fixture(scope="module")
def surface() -> trimesh.Trimesh:
    volume = fused()
    chunks = np.unique(volume.blocks // CHUNK, axis=0)
    made = weld(chunk_surfaces(volume, chunks, 1.5), chunks, volume.voxel)
    return trimesh.Trimesh(made.vertices, made.faces, process=False)


def test_sphere_comes_back(surface: trimesh.Trimesh) -> None:
    error = np.abs(np.linalg.norm(surface.vertices, axis=1) - RADIUS)
    assert 0 < error.mean() < 0.15 * VOXEL
    assert np.percentile(error, 99) < VOXEL
    # The poles are never seen; the rest is: a sphere's area is 4 pi r².
    assert 0.6 < surface.area / (4 * np.pi * RADIUS**2) < 1.02


def test_faces_look_outwards(surface: trimesh.Trimesh) -> None:
    outward = (surface.face_normals * surface.triangles_center).sum(1) > 0
    assert outward.mean() > 0.99


def test_chunks_are_welded_without_seams(surface: trimesh.Trimesh) -> None:
    """The sphere crosses several chunks; open edges stand only where the views end, near the poles."""
    edges, counts = np.unique(np.sort(surface.edges, axis=1), axis=0, return_counts=True)
    assert counts.max() == 2
    open_ends = surface.vertices[edges[counts == 1]].reshape(-1, 3)
    assert len(open_ends) == 0 or np.abs(open_ends[:, 1]).min() > 0.5 * RADIUS


def test_vertices_carry_colour_and_label_of_their_side(surface: trimesh.Trimesh) -> None:
    views = (painted(view) for view in orbit(24))
    colors, labels = paint(np.asarray(surface.vertices, np.float32), views, (7, 3), tolerance=4 * VOXEL)
    clear = np.abs(surface.vertices[:, 0]) > 0.05
    assert set(np.unique(labels)) <= {3, 7, VOID}
    assert (labels == VOID).mean() < 0.02
    wanted = np.where(surface.vertices[:, 0] < 0, 7, 3)
    assert (labels == wanted)[clear & (labels != VOID)].mean() > 0.995
    red = colors[:, 0].astype(int) - colors[:, 2]
    assert (np.sign(red) == -np.sign(surface.vertices[:, 0]))[clear & (labels != VOID)].mean() > 0.99


def test_a_step_of_the_depth_leaves_no_slit() -> None:
    """Half of a wall 15 cm nearer than the other: 7 voxels, more than the truncation. No view sees the step itself."""

    def wall(right: float) -> PosedDepth:
        pose = np.eye(4)
        pose[0, 3] = -right
        depth = np.where(pixel_rays()[..., 0] + right < 0, 1.0, 1.15).astype(np.float32)
        return PosedDepth(CAMERA, pose, depth, np.ones(depth.shape, np.float32))

    views = [wall(0.0), wall(0.0), wall(0.0), wall(0.2)]
    steps = []
    for closing in (False, True):
        x, _, z = extracted(views, VOXEL, 100_000, 0.5, closing=closing).triangles_center.T
        between = (z > 1.04) & (z < 1.11)
        steps.append(int(between.sum()))
        assert np.abs(x[between]).max(initial=0) < 0.06
    assert steps[0] < 0.5 * steps[1]
    assert steps[1] > 100
    # A rim that stands before nothing gets no thickness
    alone = [replace(v, trust=np.where(v.depth < 1.1, 1, 0).astype(np.float32)) for v in views]
    assert np.abs(extracted(alone, VOXEL, 100_000, 0.5).triangles_center[:, 2] - 1).max() < VOXEL


def test_what_a_view_sees_in_slits_and_holes_is_covered_at_its_depth() -> None:
    """Half of a wall 15 cm nearer than the other, more than the truncation, and a hole where one view is not sure."""

    def wall(right: float) -> PosedDepth:
        pose = np.eye(4)
        pose[0, 3] = -right
        depth = np.where(pixel_rays()[..., 0] + right < 0, 1.0, 1.15).astype(np.float32)
        trust = np.ones(depth.shape, np.float32)
        trust[20:30, 10:24] = 0
        return PosedDepth(CAMERA, pose, depth, trust)

    views = [wall(0.0), wall(0.0), wall(0.1)]
    found = extracted(views[:2], VOXEL, 100_000, 0.5, closing=False)
    mesh = MeshArrays(
        found.vertices.astype(np.float32), found.faces.astype(np.int32),
        np.full((len(found.vertices), 3), 7, np.uint8), np.full(len(found.vertices), 3, np.uint8),
    )  # fmt: skip
    whole = patched(mesh, views, 100_000)

    def enclosed(mesh: MeshArrays, view: PosedDepth) -> int:
        drawn = draw_faces(mesh.vertices, mesh.faces, view.cam_from_world, view.intrinsics)
        inside = binary_fill_holes(np.pad(drawn.face >= 0, 1, mode="edge"))[1:-1, 1:-1]
        return int((inside & (drawn.face < 0)).sum())

    assert enclosed(mesh, views[0]) > 100
    assert [enclosed(whole, view) for view in views] == [0, 0, 0]
    new = whole.vertices[whole.faces[len(mesh.faces) :]]
    assert np.abs(new[..., 2:] - [1, 1.15]).min(-1).max() < 0.04
    assert np.ptp(new[..., 2], axis=1).max() < 0.03
    assert (np.cross(new[:, 1] - new[:, 0], new[:, 2] - new[:, 0])[:, 2] < 0).all(), "they look at the camera"
    assert (set(whole.colors.flat), set(whole.labels)) == ({7}, {3})
    assert len(patched(whole, views, 100_000).faces) - len(whole.faces) < 0.1 * len(new)
    few = patched(mesh, views, len(whole.faces) - 1)
    assert len(mesh.faces) < len(few.faces) < 0.5 * (len(mesh.faces) + len(whole.faces))
    assert [enclosed(few, view) for view in views] == [0, 0, 0], "of coarser pixels"
    nothing = MeshArrays(mesh.vertices[:0], mesh.faces[:0], mesh.colors[:0], mesh.labels[:0])
    assert len(patched(nothing, views, 100_000).faces) == 0


def test_unseen_vertices_are_as_the_nearest_seen_one() -> None:
    shown = see_ball(0.0)
    seen = seen_points(shown)[shown.trust > 0][:1]
    points = np.concatenate([seen, seen * 1.5]).astype(np.float32)
    colors, labels = paint(points, [painted(shown)], (3, 7), 2 * VOXEL)
    assert labels[0] != VOID
    assert labels[1] == labels[0]
    assert (colors[1] == colors[0]).all()


def test_voxels_grow_until_the_blocks_fit() -> None:
    fine, coarse = fused(6), fused(6, max_blocks=150)
    assert len(coarse.blocks) <= 150 < len(fine.blocks)
    assert coarse.voxel > fine.voxel


def test_threads_do_not_change_a_byte() -> None:
    before = get_threads()
    try:
        set_threads(1)
        one = fused(6)
        set_threads(2)
        two = fused(6)
    finally:
        set_threads(before)
    assert one.distance.tobytes() == two.distance.tobytes()
    assert one.weight.tobytes() == two.weight.tobytes()


def test_small_pieces_go_and_are_counted_over_all_regions() -> None:
    """Strips of unit squares along x; the second chunk begins at 64."""

    def strips(*ends: tuple[int, int, int]) -> list[Triangles]:
        parts = []
        for first, last, y in ends:
            points = np.array([(x, y + side, 1.5) for x in range(first, last + 1) for side in (0, 1)], float)
            corners = 2 * np.arange(last - first)[:, None, None] + [[0, 2, 1], [1, 2, 3]]
            faces = corners.reshape(-1, 3).astype(np.int32)
            parts.append((points, faces, np.zeros(len(faces), bool)))
        return parts

    first = weld(strips((1, 64, 5), (56, 64, 8), (10, 18, 20)), np.array([[0, 0, 0]], np.int32), 1.0)
    second = weld(strips((64, 127, 5), (64, 72, 8)), np.array([[1, 0, 0]], np.int32), 1.0)
    assert (len(first.border), len(second.border)) == (4, 4)
    sizes = {share: len(whole([first, second], share).faces) for share in (0.06, 0.1, 0.13)}
    assert sizes == {0.06: 252 + 32 + 16, 0.1: 252 + 32, 0.13: 252}
    kept = whole([first, second], 0.1)
    assert len(kept.vertices) == 2 * 127 + 2 * 17
    assert kept.area == pytest.approx(126 + 16)
    assert len(trimesh.graph.connected_components(kept.edges)) == 2


@pytest.mark.parametrize("at_once", [1, 40])
def test_regions_give_the_mesh_of_the_whole(at_once: int) -> None:
    """The sphere crosses several chunks; not every view sees each. What closes slits depends on the region's faces."""
    views = orbit(12)
    whole, parts = (extracted(views, 0.012, n, closing=False) for n in (10_000_000, at_once))
    assert len(whole.vertices) == len(parts.vertices) > 5000
    assert len(whole.faces) == len(parts.faces)
    np.testing.assert_array_equal(*(np.unique(m.triangles_center.round(7), axis=0) for m in (whole, parts)))
    assert parts.edges_unique.shape == whole.edges_unique.shape  # sewn together where regions meet


def test_a_view_is_fused_wherever_it_sees_anything() -> None:
    """Left away are only views that would change nothing."""
    views = Corridor(24)
    grid = make_grid(views, 0.1, 4.0, 10_000_000)
    left_away = 0
    for chunks in grid.regions(1):
        near = grid.views_of(chunks)
        left_away += len(views) - len(near)
        some, all_of_them = fuse(grid, chunks, (views[n] for n in near)), fuse(grid, chunks, views)
        assert some.weight.tobytes() == all_of_them.weight.tobytes()
        assert some.distance.tobytes() == all_of_them.distance.tobytes()
    assert left_away > 10


def test_memory_of_a_mesh_does_not_grow_with_the_length(tmp_path: Path) -> None:
    def peak(count: int) -> float:
        tracemalloc.start()
        views, files = Corridor(count), []
        grid = make_grid(views, 0.1, 4.0, 10_000_000)
        for number, chunks in enumerate(grid.regions(12)):
            surface = surface_of(grid, views, chunks, 0.5)
            grey = np.full((len(surface.vertices), 3), 128, np.uint8)
            files.append(tmp_path / f"{number}.npz")
            save_value(files[-1], Region(surface, grey, grey[:, 0]))
        write_mesh_ply(tmp_path / "mesh.ply", joined(lambda: map(load_value, files)))
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert np.ptp(read_mesh_ply(tmp_path / "mesh.ply").vertices[:, 2]) > 0.45 * count
        return found

    peak(2)
    assert peak(36) < 1.2 * peak(12)
