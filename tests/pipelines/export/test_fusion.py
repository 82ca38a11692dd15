"""Fusion of depth images of a sphere with a known surface."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipelines.config import ExportConfig
from pipelines.export.fusion import BLOCK, TsdfVolume, pack_keys, touched_blocks, unpack_keys, weld
from pipelines.export.mesh import SurfaceView, drop_floaters, fuse_mesh
from pipelines.gaussians.render import set_threads
from pipelines.progress import SilentProgress
from pipelines.types import VOID, Intrinsics

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
RADIUS = 0.5


def orbit(count: int) -> list[NDArray[np.float64]]:
    """cam_from_world of cameras 2 away from the origin, looking at it, all round."""
    poses = []
    for angle in np.arange(count) * 2 * np.pi / count:
        forward = -np.array([np.cos(angle), 0.4 * np.sin(3 * angle), np.sin(angle)])
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (-2.0 * forward)
        poses.append(pose)
    return poses


def sphere_depth(pose: NDArray[np.float64]) -> NDArray[np.float32]:
    """Exact z-depth of the sphere at the origin, 0 beside it."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], axis=-1)
    center = pose[:3, 3]
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - RADIUS**2
    root = b**2 - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


def sphere_view(pose: NDArray[np.float64]) -> SurfaceView:
    """Left half of the world (x < 0) is class 0 and red, the other class 1 and blue."""
    depth = sphere_depth(pose)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], axis=-1)
    world = (rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
    left = world[..., 0] < 0
    color = np.where(left[..., None], [200, 0, 0], [0, 0, 200]).astype(np.uint8)
    labels = np.where(depth > 0, np.where(left, 0, 1), VOID).astype(np.uint8)
    return SurfaceView(pose, depth, color, labels, (depth > 0).astype(np.float32))


def fused(count: int = 24, settings: ExportConfig | None = None) -> trimesh.Trimesh:
    views = [sphere_view(pose) for pose in orbit(count)]
    mesh = fuse_mesh(views.__getitem__, count, CAMERA, 2, settings or ExportConfig(), SilentProgress())
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    shape.metadata.update(colors=mesh.colors, labels=mesh.labels)
    return shape


def test_sphere_comes_back() -> None:
    mesh = fused()
    distance = np.linalg.norm(mesh.vertices, axis=1)
    voxel = 1.5 / CAMERA.fx * ExportConfig().mesh_voxel_px
    assert 0 < np.abs(distance - RADIUS).mean() < 0.15 * voxel
    assert np.abs(distance - RADIUS).max() < 1.5 * voxel
    # The poles are never seen; the rest is: a sphere's area is 4 pi r^2.
    assert 0.6 < mesh.area / (4 * np.pi * RADIUS**2) < 1.02


def test_chunks_are_welded_without_seams() -> None:
    """Open edges stand only where the views end, near the poles."""
    mesh = fused()
    edges = np.sort(mesh.edges, axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    open_ends = mesh.vertices[unique[counts == 1]].reshape(-1, 3)
    assert len(open_ends) == 0 or np.abs(open_ends[:, 1]).min() > 0.5 * RADIUS


def test_vertices_carry_the_colour_and_label_of_their_side() -> None:
    mesh = fused()
    colors, labels = mesh.metadata["colors"], mesh.metadata["labels"]
    clear = np.abs(mesh.vertices[:, 0]) > 0.05
    right = (labels == (mesh.vertices[:, 0] > 0)) | (labels == VOID)
    assert right[clear].mean() > 0.995
    assert (labels == VOID).mean() < 0.02
    red = colors[:, 0].astype(int) - colors[:, 2]
    assert (np.sign(red) == -np.sign(mesh.vertices[:, 0]))[clear].mean() > 0.99


def test_voxels_grow_when_memory_is_short() -> None:
    fine, coarse = fused(8), fused(8, ExportConfig(mesh_memory_mb=0.4))
    assert 0 < len(coarse.vertices) < 0.7 * len(fine.vertices)


def test_threads_do_not_change_a_byte() -> None:
    try:
        set_threads(1)
        one = fused(6)
        set_threads(2)
        two = fused(6)
    finally:
        set_threads(0)
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert one.faces.tobytes() == two.faces.tobytes()


def test_nothing_seen_gives_an_empty_mesh() -> None:
    view = sphere_view(orbit(1)[0])
    empty = SurfaceView(view.cam_from_world, view.depth * 0, view.color, view.labels, view.coverage * 0)
    mesh = fuse_mesh(lambda i: empty, 2, CAMERA, 2, ExportConfig(), SilentProgress())
    assert len(mesh.vertices) == len(mesh.faces) == 0


def test_keys_round_trip_and_touch_the_surface() -> None:
    positions = np.random.default_rng(0).integers(-1000, 1000, (50, 3))
    assert (unpack_keys(pack_keys(positions)) == positions).all()
    pose = orbit(1)[0]
    volume = TsdfVolume.empty(0.02, touched_blocks(sphere_depth(pose), pose, CAMERA, 0.02))
    centers = (unpack_keys(volume.keys) + 0.5) * BLOCK * 0.02
    distance = np.abs(np.linalg.norm(centers, axis=1) - RADIUS)
    assert distance.max() < 0.02 * (4 + BLOCK * np.sqrt(3))
    with pytest.raises(ValueError, match="too large"):
        pack_keys(np.array([[1 << 20, 0, 0]]))


def test_weld_and_floaters() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    vertices, faces = weld(square, np.array([[0, 1, 2], [3, 4, 5]]), 1.0)
    assert vertices.shape == (4, 3)
    far = np.array([[9, 9, 9], [9, 8, 9], [8, 9, 9]], np.float32)
    both = np.concatenate([vertices, far]), np.concatenate([faces, [[4, 5, 6]]]).astype(np.int32)
    kept, left = drop_floaters(*both, min_part=0.4)
    assert (len(kept), len(left)) == (4, 2)
