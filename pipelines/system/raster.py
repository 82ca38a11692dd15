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
    pixels, across = np.empty((len(in_cam), 2)), (np.arange(width) + 0.5 - cx) / fx
    for k in range(len(in_cam)):
        near = 1 / max(in_cam[k, 2], 1e-300)
        pixels[k, 0], pixels[k, 1] = fx * in_cam[k, 0] * near + cx, fy * in_cam[k, 1] * near + cy
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        az, bz, gz = in_cam[a, 2], in_cam[b, 2], in_cam[c, 2]
        if max(az, bz, gz) <= 0:
            continue
        left, right, top, bottom = 0, width - 1, 0, height - 1
        if min(az, bz, gz) > 0:
            u, v, w = pixels[a, 0], pixels[b, 0], pixels[c, 0]
            left, right = max(left, int(max(min(u, v, w) - 1, 0))), min(right, int(min(max(u, v, w, -1), width)))
            u, v, w = pixels[a, 1], pixels[b, 1], pixels[c, 1]
            top, bottom = max(top, int(max(min(u, v, w) - 1, 0))), min(bottom, int(min(max(u, v, w, -1), height)))
        if left > right or top > bottom:
            continue
        ax, ay, bx, by, gx, gy = in_cam[a, 0], in_cam[a, 1], in_cam[b, 0], in_cam[b, 1], in_cam[c, 0], in_cam[c, 1]
        # Products of two corners each: written out, for arrays of three would take most of the time.
        bcx, bcy, bcz = by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx
        cax, cay, caz = gy * az - gz * ay, gz * ax - gx * az, gx * ay - gy * ax
        abx, aby, abz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        volume = ax * bcx + ay * bcy + az * bcz
        if volume == 0:
            continue
        side = 1.0 if volume > 0 else -1.0
        for row in range(top, bottom + 1):
            y = (row + 0.5 - cy) / fy
            pc, qc, rc = side * (bcy * y + bcz), side * (cay * y + caz), side * (aby * y + abz)
            for column in range(left, right + 1):
                x = side * across[column]
                p, q, r = bcx * x + pc, cax * x + qc, abx * x + rc
                total = p + q + r
                if total <= 0 or min(p, q, r) < 0:
                    continue
                z = abs(volume) / total
                if z < depth[row, column]:
                    depth[row, column], face[row, column] = z, f
                    shares[row, column, 0], shares[row, column, 1] = p / total, q / total
                    shares[row, column, 2] = r / total
