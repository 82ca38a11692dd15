"""Rigid pinhole cameras: projection, and images resampled to another size."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..types import Intrinsics, ProxyMaps

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
    inverse_depth = torch.where(z > near, z, torch.ones_like(z)).reciprocal()
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
    """All of a frame's maps at another size."""
    if maps.depth.shape == (height, width):
        return maps
    sampled = (resample_nearest(m, height, width) for m in (maps.confidence, maps.labels, maps.label_confidence))
    return ProxyMaps(resize_depth(maps.depth, height, width), *sampled)
