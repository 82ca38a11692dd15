"""Rigid pinhole cameras: projection, images resampled to another size, and rigs of cameras: each panorama is the six
sides of a cube about its centre."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Array, Intrinsics, ProxyMaps, require_shape

if TYPE_CHECKING:
    from torch import Tensor

LEVEL = 4
"""The first so many sides look to the horizon."""
_AHEAD = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
_DOWN = np.array([[0, 1, 0]] * LEVEL + [[0, 0, 1], [0, 0, -1]], np.float64)
CUBE = np.stack([np.cross(_DOWN, _AHEAD), _DOWN, _AHEAD], axis=1)
"""(6, 3, 3) side_from_rig: front, right, back, left, up, down; the rig's axes are those of its front."""

_ONE_SURFACE = 0.02
"""Relative standard deviation up to which depths side by side are of one surface."""


def project(
    points_in_cam: NDArray[np.float64], intrinsics: Intrinsics
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(..., 3) points -> pixels (..., 2) and depths (...,); pixels of points not in front of the camera are NaN."""
    depth = points_in_cam[..., 2]
    safe = np.where(depth > 0, depth, np.nan)
    u = intrinsics.fx * points_in_cam[..., 0] / safe + intrinsics.cx
    v = intrinsics.fy * points_in_cam[..., 1] / safe + intrinsics.cy
    return np.stack([u, v], axis=-1), depth


def unproject(xy: NDArray[np.float64], depth: NDArray[np.float64], intrinsics: Intrinsics) -> NDArray[np.float64]:
    """(..., 2) pixels at (...,) depths -> (..., 3) points in the camera; the inverse of `project`."""
    x = (xy[..., 0] - intrinsics.cx) / intrinsics.fx
    y = (xy[..., 1] - intrinsics.cy) / intrinsics.fy
    return np.stack([x * depth, y * depth, depth], axis=-1)


def nearest_along(ray1: Array, ray2: Array, centre2: Array, cosine: Array) -> tuple[Array, Array]:
    """Return how far along unit rays (Q, 3) from the origin and from `centre2` (3,) the two are nearest to each other,
    for the cosines (Q,) of their angles."""
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along1, along2 = ray1 @ centre2, ray2 @ centre2
    return (along1 - cosine * along2) / sine2, (cosine * along1 - along2) / sine2


def pixel_centers(width: int, height: int) -> NDArray[np.float64]:
    """(H, W, 2) the (x, y) of every pixel's centre."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def unproject_depth(depth: NDArray[np.floating], intrinsics: Intrinsics) -> NDArray[np.float64]:
    """(H, W) depth image -> (H, W, 3) points in the camera; unknown depth (0) gives the camera's centre."""
    return unproject(pixel_centers(depth.shape[1], depth.shape[0]), depth.astype(np.float64), intrinsics)


def project_gaussians(
    means_in_cam: Tensor, radii: Tensor, intrinsics: Intrinsics, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """MSGS-SLAM eq. (5): (M, 3) centres and (M,) radii -> u, v, sigma_px, z, each (M,), differentiable.

    Centres at z <= near are divided by 1 instead, which keeps values and gradients finite; whoever composites skips
    them. An isotropic Gaussian stays isotropic: the focal length of its radius is the geometric mean of fx and fy.
    """
    x, y, z = means_in_cam.unbind(-1)
    inverse_depth = z.where(z > near, z.new_ones(())).reciprocal()
    u = intrinsics.fx * (x * inverse_depth) + intrinsics.cx
    v = intrinsics.fy * (y * inverse_depth) + intrinsics.cy
    sigma_px = (intrinsics.fx * intrinsics.fy) ** 0.5 * (radii * inverse_depth)
    return u, v, sigma_px, z


def resample_nearest(array: NDArray, height: int, width: int) -> NDArray:
    """(H, W, ...) → (height, width, ...): each pixel takes the value under its centre."""
    rows = ((np.arange(height) + 0.5) * array.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * array.shape[1] / width).astype(np.int64)
    return np.ascontiguousarray(array[rows[:, None], columns[None, :]])


def resize_depth(depth: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """(H, W) → (height, width): of a smaller image the mean of what each pixel covers, where that is one surface and
    known whole; else the value under its centre.

    The mean of the inverse, which is linear on a plane. Under the centre of two by two pixels is their corner: one of
    them is half a pixel aside, which is per cents of the depth where a floor recedes.
    """
    nearest = resample_nearest(depth, height, width)
    if height >= depth.shape[0] or width >= depth.shape[1]:
        return nearest
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan).astype(np.float32)
    mean, square = (cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA) for x in (inverse, inverse**2))
    is_one = square < (1 + _ONE_SURFACE**2) * mean**2  # not so of NaN
    return np.where(is_one, 1 / mean, nearest).astype(np.float32)


def resize_maps(maps: ProxyMaps, height: int, width: int) -> ProxyMaps:
    """Resize all of a frame's maps to another size."""
    if maps.depth.shape == (height, width):
        return maps
    sampled = (resample_nearest(m, height, width) for m in (maps.confidence, maps.labels, maps.label_confidence))
    return ProxyMaps(resize_depth(maps.depth, height, width), *sampled)


@dataclass(frozen=True)
class Rig:
    """Cameras of one kind that look from one point: at each of `stations` places camera c takes frame
    c * stations + place, so that the frames of one camera follow each other.

    cam_from_rig (C, 3, 3): how each is turned. Of a single camera every frame is a place.
    """

    stations: int
    cam_from_rig: Array

    def __post_init__(self) -> None:
        require_shape("cam_from_rig", self.cam_from_rig, (None, 3, 3))

    def __len__(self) -> int:
        return len(self.cam_from_rig)

    def frames_of(self, stations: Iterable[int]) -> list[int]:
        """Return the frames of all cameras at these stations, camera by camera."""
        return [c * self.stations + s for c in range(len(self)) for s in stations]

    @property
    def motions(self) -> Array:
        """(C, 4, 4) cam_from_rig."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        out[:, :3, :3] = self.cam_from_rig
        return out


ONE_CAMERA = Rig(1 << 62, np.eye(3)[None])
"""Whatever the number of a frame, it is a place of its own."""


def rig_of(directions: int, frames: int) -> Rig:
    """Return the rig of `frames` frames in all, taken in 1 or 6 directions."""
    return Rig(frames // len(CUBE), CUBE) if directions == len(CUBE) else ONE_CAMERA


def reduce_to_rig(
    blocks: Array, pairs: NDArray[np.int64], right: Array, frame_ids: NDArray[np.int64], rig: Rig
) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """Reduce the upper blocks (B, 6, 6) at pairs (B, 2) and right sides (6 N,) of N cameras as those of their S places.

    A step d of a place moves its camera c by adjoint(cam_from_rig[c]) d, which here is a turn of both halves: see
    Sola et al., A micro Lie theory for state estimation in robotics, eq. (20). Returns blocks, pairs, right sides, the
    place of each camera (N,) and the turns (N, 6, 6).
    """
    _, place = np.unique(frame_ids % rig.stations, return_inverse=True)
    turns = np.zeros((len(rig), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = rig.cam_from_rig
    turns = turns[frame_ids // rig.stations]
    moved = np.swapaxes(turns[pairs[:, 0]], 1, 2) @ blocks @ turns[pairs[:, 1]]
    first, second = place[pairs[:, 0]], place[pairs[:, 1]]
    within = (first == second) & (pairs[:, 0] != pairs[:, 1])
    moved[within] += np.swapaxes(moved[within], 1, 2)
    turned = first > second
    moved[turned] = np.swapaxes(moved[turned], 1, 2)
    of_places = np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1)
    kept, row = np.unique(of_places, axis=0, return_inverse=True)
    total = np.zeros((len(kept), 6, 6))
    np.add.at(total, row.ravel(), moved)
    pull = np.zeros((int(place.max()) + 1, 6))
    np.add.at(pull, place, np.einsum("nji,nj->ni", turns, right.reshape(-1, 6)))
    return total, kept, pull.ravel(), place, turns
