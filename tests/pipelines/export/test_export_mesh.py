"""Fusion of depth images of a sphere whose surface, colours and classes are known."""

import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipelines.depth.posed import PosedDepth
from pipelines.export.depth_views import DrawnView, ViewsOnDisk
from pipelines.export.paint import paint
from pipelines.export.surface import EMPTY, extract_surface, join_faces, without_floaters
from pipelines.export.volume import CHUNK, Grid, Volume, fuse, make_grid
from pipelines.types import VOID, Intrinsics

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
RADIUS, VOXEL = 0.5, 0.02


def orbit(count: int) -> list[NDArray[np.float64]]:
    """cam_from_world of cameras at a distance of 2 from the origin, looking at it, all round."""
    poses = []
    for angle in np.arange(count) * 2 * np.pi / count:
        forward = -np.array([np.cos(angle), 0.4 * np.sin(3 * angle), np.sin(angle)])
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ (-2.0 * forward)
        poses.append(pose)
    return poses


def pixel_rays() -> NDArray[np.float64]:
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    return np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], axis=-1)


def sphere(pose: NDArray[np.float64]) -> PosedDepth:
    """Exact z-depth of the sphere at the origin, 0 beside it."""
    rays, center = pixel_rays(), pose[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - RADIUS**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)
    return PosedDepth(CAMERA, pose, depth, (depth > 0).astype(np.float32))


def painted(view: PosedDepth) -> DrawnView:
    """Where x < 0 in the world channel 0 and red, else channel 1 and blue."""
    points = (pixel_rays() * view.depth[..., None] - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
    left = points[..., 0] < 0
    colors = np.where(left[..., None], [204, 0, 0], [0, 0, 204]).astype(np.uint8)
    return DrawnView(view, colors, np.where(left, 0, 1).astype(np.int16))


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


def fused(count: int = 24, max_blocks: int = 100_000, threads: int = 2) -> Volume:
    views = [sphere(p) for p in orbit(count)]
    grid = make_grid(views, VOXEL, 4.0, max_blocks)
    return fuse(grid, all_chunks(grid), views, threads)


def all_chunks(grid: Grid) -> NDArray[np.int32]:
    return np.unique(grid.blocks // CHUNK, axis=0)


def extracted(views: Sequence[PosedDepth], voxel: float, at_once: int, least: float = 1.5) -> trimesh.Trimesh:
    """The surface, made region by region."""
    grid = make_grid(views, voxel, 4.0, 10_000_000)
    surfaces = [
        extract_surface(fuse(grid, chunks, (views[n] for n in grid.views_of(chunks)), 1), chunks, least)
        for chunks in grid.regions(at_once)
    ]
    vertices = np.concatenate([s.vertices for s in surfaces])
    rows, faces = without_floaters(join_faces(surfaces), len(vertices), 0.0)
    return trimesh.Trimesh(vertices[rows], faces, process=False)


@pytest.fixture(scope="module")
def surface() -> trimesh.Trimesh:
    volume = fused()
    whole = extract_surface(volume, np.unique(volume.blocks // CHUNK, axis=0), 1.5)
    return trimesh.Trimesh(whole.vertices, whole.faces, process=False)


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
    views = (painted(sphere(p)) for p in orbit(24))
    colors, labels = paint(np.asarray(surface.vertices, np.float32), views, (7, 3), tolerance=4 * VOXEL)
    clear = np.abs(surface.vertices[:, 0]) > 0.05
    assert set(np.unique(labels)) <= {3, 7, VOID}
    assert (labels == VOID).mean() < 0.02
    wanted = np.where(surface.vertices[:, 0] < 0, 7, 3)
    assert (labels == wanted)[clear & (labels != VOID)].mean() > 0.995
    red = colors[:, 0].astype(int) - colors[:, 2]
    assert (np.sign(red) == -np.sign(surface.vertices[:, 0]))[clear & (labels != VOID)].mean() > 0.99


def test_unseen_vertices_are_grey_and_void() -> None:
    colors, labels = paint(np.array([[9, 9, 9]], np.float32), [painted(sphere(orbit(1)[0]))], (0, 1), 0.1)
    assert colors.tolist() == [[128, 128, 128]]
    assert labels.tolist() == [VOID]


def test_voxels_grow_until_the_blocks_fit() -> None:
    fine, coarse = fused(6), fused(6, max_blocks=150)
    assert len(coarse.blocks) <= 150 < len(fine.blocks)
    assert coarse.voxel > fine.voxel


def test_threads_do_not_change_a_byte() -> None:
    one, two = fused(6, threads=1), fused(6, threads=2)
    assert one.distance.tobytes() == two.distance.tobytes()
    assert one.weight.tobytes() == two.weight.tobytes()


def test_nothing_seen_gives_an_empty_surface() -> None:
    view = sphere(orbit(1)[0])
    nothing = PosedDepth(CAMERA, view.cam_from_world, view.depth * 0, view.trust * 0)
    grid = make_grid([nothing, nothing], VOXEL, 4.0, 1000)
    assert list(grid.regions()) == []
    assert len(fuse(grid, all_chunks(grid), [nothing], 1).blocks) == 0
    assert join_faces([EMPTY]).shape == (0, 3)


def test_small_pieces_go() -> None:
    plane = trimesh.creation.icosphere(subdivisions=3)
    speck = trimesh.creation.icosahedron()
    both = trimesh.util.concatenate([plane, speck.apply_translation([9, 9, 9])])
    rows, faces = without_floaters(both.faces.astype(np.int32), len(both.vertices), 0.05)
    assert (len(rows), len(faces)) == (len(plane.vertices), len(plane.faces))
    assert np.abs(both.vertices[rows]).max() < 2
    np.testing.assert_array_equal(both.vertices[rows][faces], plane.triangles)


@pytest.mark.parametrize("at_once", [1, 40])
def test_regions_give_the_mesh_of_the_whole(at_once: int) -> None:
    """The sphere crosses several chunks; not every view sees each."""
    views = [sphere(p) for p in orbit(12)]
    whole, parts = extracted(views, 0.012, 10_000_000), extracted(views, 0.012, at_once)
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
        some, all_of_them = fuse(grid, chunks, (views[n] for n in near), 1), fuse(grid, chunks, views, 1)
        assert some.weight.tobytes() == all_of_them.weight.tobytes()
        assert some.distance.tobytes() == all_of_them.distance.tobytes()
    assert left_away > 10


def test_memory_of_fusing_does_not_grow_with_the_length() -> None:
    def peak(count: int) -> float:
        tracemalloc.start()
        mesh = extracted(Corridor(count), 0.1, 12, least=0.5)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert np.ptp(mesh.vertices[:, 2]) > 0.45 * count
        return found - 3 * (mesh.vertices.nbytes + mesh.faces.nbytes)  # the mesh itself does

    extracted(Corridor(2), 0.1, 12)
    assert peak(36) < 1.2 * peak(12)


def test_views_come_back_from_disk(tmp_path: Path) -> None:
    rng, kept = np.random.default_rng(0), ViewsOnDisk(tmp_path)
    shown = sphere(orbit(1)[0])
    colors = rng.integers(0, 255, (3, 120, 160, 3)).astype(np.uint8)
    channels = [None, rng.integers(-1, 4, (120, 160)).astype(np.int16), None]
    for color, channel in zip(colors, channels, strict=True):
        kept.append(DrawnView(shown, color, channel))
    assert list(tmp_path.iterdir()) == []
    for n in (2, 0, 1):
        view = kept.load(n)
        assert (view.shown.intrinsics, view.shown.cam_from_world.tolist()) == (CAMERA, shown.cam_from_world.tolist())
        for found, wanted in zip(view.arrays, DrawnView(shown, colors[n], channels[n]).arrays, strict=True):
            assert found.dtype == wanted.dtype
            np.testing.assert_array_equal(found, wanted)
