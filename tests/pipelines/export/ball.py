"""A ball around the origin, seen all round from a distance of 2 with exact depth."""

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
RADIUS = 0.5


def pixel_rays(camera: Intrinsics = CAMERA) -> NDArray[np.float64]:
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)


def see_ball(angle: float, camera: Intrinsics = CAMERA) -> PosedDepth:
    """Exact depth of the ball, 0 beside it."""
    forward = -np.array([np.cos(angle), 0.3 * np.sin(3 * angle), np.sin(angle)])
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    center = pose[:3, 3] = pose[:3, :3] @ (2.0 * forward)
    rays = pixel_rays(camera)
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - RADIUS**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)
    return PosedDepth(camera, pose, depth, (depth > 0).astype(np.float32))


def orbit(count: int) -> list[PosedDepth]:
    return [see_ball(angle) for angle in np.arange(count) * 2 * np.pi / count]


def seen_points(view: PosedDepth) -> NDArray[np.float64]:
    """Where in the world its pixels lie."""
    pose = view.cam_from_world
    return (pixel_rays(view.intrinsics) * view.depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
