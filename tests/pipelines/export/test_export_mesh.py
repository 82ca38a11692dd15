"""Fusion of depth images of a sphere whose surface, colours and classes are known."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipelines.depth.posed import PosedDepth
from pipelines.export.depth_views import DrawnView
from pipelines.export.paint import paint
from pipelines.export.surface import extract_surface, without_floaters
from pipelines.export.volume import Volume, fuse
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


def fused(count: int = 24, max_blocks: int = 100_000, threads: int = 2) -> Volume:
    return fuse([sphere(p) for p in orbit(count)], VOXEL, 4.0, max_blocks, threads)


@pytest.fixture(scope="module")
def surface() -> trimesh.Trimesh:
    return trimesh.Trimesh(*extract_surface(fused(), 1.5), process=False)


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
    vertices, faces = extract_surface(fuse([nothing, nothing], VOXEL, 4.0, 1000, 1), 1.0)
    assert len(vertices) == len(faces) == 0


def test_small_pieces_go() -> None:
    plane = trimesh.creation.icosphere(subdivisions=3)
    speck = trimesh.creation.icosahedron()
    both = trimesh.util.concatenate([plane, speck.apply_translation([9, 9, 9])])
    vertices, faces = without_floaters(both.vertices.astype(np.float32), both.faces.astype(np.int32), 0.05)
    assert (len(vertices), len(faces)) == (len(plane.vertices), len(plane.faces))
    assert np.abs(vertices).max() < 2
