"""Triangles as a camera sees them: the nearest one at every pixel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Array, Intrinsics
from .jit import kernel


@dataclass(frozen=True)
class FaceImage:
    """The nearest `face` (H, W) int32 at every pixel's centre, -1 = none, the `shares` (H, W, 3) float32 of its corners
    in the place that is seen, and its `depth` (H, W) float32 along the optical axis, 0 = none."""

    face: NDArray[np.int32]
    shares: NDArray[np.float32]
    depth: NDArray[np.float32]


def draw_faces(vertices: NDArray, faces: NDArray[np.int32], cam_from_world: Array, camera: Intrinsics) -> FaceImage:
    """Draw triangles (F, 3) of vertices (V, 3) from a pose (4, 4), both of their sides; those that reach behind the
    camera are drawn as far as they are in front of it."""
    in_cam = vertices.astype(np.float64) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    size = (camera.height, camera.width)
    face, shares, depth = np.full(size, -1, np.int32), np.zeros((*size, 3), np.float32), np.full(size, np.inf)
    _draw(in_cam, np.ascontiguousarray(faces, np.int32), np.array(camera.numbers, np.float64), face, shares, depth)
    return FaceImage(face, shares, np.where(face >= 0, depth, 0).astype(np.float32))


@kernel
def _draw(in_cam, faces, camera, face, shares, depth):  # type: ignore[no-untyped-def]
    """In homogeneous coordinates (Olano and Greer 1997): no corner is divided by its own depth. Beside a common edge
    the shares of two faces are the same numbers with opposite signs: no gap between them."""
    height, width = face.shape
    fx, fy, cx, cy = camera
    for f in range(len(faces)):
        a, b, c = in_cam[faces[f, 0]], in_cam[faces[f, 1]], in_cam[faces[f, 2]]
        bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
        volume = (a * bc).sum()
        if volume == 0 or max(a[2], b[2], c[2]) <= 0:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if min(a[2], b[2], c[2]) > 0:
            u = np.array([fx * a[0] / a[2], fx * b[0] / b[2], fx * c[0] / c[2]]) + cx
            v = np.array([fy * a[1] / a[2], fy * b[1] / b[2], fy * c[1] / c[2]]) + cy
            left, right = max(left, int(max(u.min() - 1, 0))), min(right, int(min(max(u.max(), -1), width)))
            top, bottom = max(top, int(max(v.min() - 1, 0))), min(bottom, int(min(max(v.max(), -1), height)))
        for row in range(top, bottom + 1):
            y = (row + 0.5 - cy) / fy
            for column in range(left, right + 1):
                x = (column + 0.5 - cx) / fx
                p = (bc[0] * x + bc[1] * y + bc[2]) / volume
                q = (ca[0] * x + ca[1] * y + ca[2]) / volume
                r = (ab[0] * x + ab[1] * y + ab[2]) / volume
                total = p + q + r
                if total <= 0 or min(p, q, r) < 0:
                    continue
                if 1 / total < depth[row, column]:
                    depth[row, column], face[row, column] = 1 / total, f
                    shares[row, column, 0], shares[row, column, 1] = p / total, q / total
                    shares[row, column, 2] = r / total
