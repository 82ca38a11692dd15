"""Camera paths for images of a finished map: the run's own, the same smoothed, or a circle round the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

Array = NDArray[np.float64]

_FROM_OUTSIDE = 1.4
"""Sizes of a scene that one stands away from its middle: then it fills most of an image of 50 degrees."""


def resampled(world_from_cam: Array, count: int) -> Array:
    """(count, 4, 4) poses evenly along the path in frames: centres linear, rotations on the shortest arc."""
    if len(world_from_cam) < 2:
        return np.repeat(world_from_cam, count, axis=0)
    at = np.linspace(0, len(world_from_cam) - 1, count)
    known = np.arange(len(world_from_cam))
    path = np.tile(np.eye(4), (count, 1, 1))
    path[:, :3, :3] = Slerp(known, Rotation.from_matrix(world_from_cam[:, :3, :3]))(at).as_matrix()
    path[:, :3, 3] = np.stack([np.interp(at, known, world_from_cam[:, k, 3]) for k in range(3)], axis=1)
    return path


def smoothed(world_from_cam: Array, sigma: float) -> Array:
    """(N, 4, 4) the path without the tremble of the hand: Gaussian means over `sigma` frames."""
    quat_xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat()
    # q and -q are one rotation; neighbours must have the same sign before they are averaged.
    flips = np.cumprod(np.concatenate([[1.0], np.where((quat_xyzw[1:] * quat_xyzw[:-1]).sum(axis=1) < 0, -1.0, 1.0)]))
    mean_quat = gaussian_filter1d(quat_xyzw * flips[:, None], sigma, axis=0, mode="nearest")
    path = world_from_cam.copy()
    path[:, :3, :3] = Rotation.from_quat(mean_quat).as_matrix()
    path[:, :3, 3] = gaussian_filter1d(world_from_cam[:, :3, 3], sigma, axis=0, mode="nearest")
    return path


def orbit(world_from_cam: Array, scene_depth: float, count: int, up: Array) -> Array:
    """(count, 4, 4) once round the place the cameras look at, at their usual distance and height.

    scene_depth: the usual distance of the scene, which stands in where the cameras do not look at one place; up (3,)
    unit vector in the world.
    """
    focus, radius, height = _focus(world_from_cam, up, scene_depth)
    start = world_from_cam[0, :3, 3] - focus
    first = start - (start @ up) * up
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-9 else _any_across(up)
    second = np.cross(up, first)
    angle = 2 * np.pi * np.arange(count) / count
    centers = focus + radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second) + height * up
    return _looking_at(centers, focus, up)


def around(middle: Array, size: float, up: Array, count: int) -> Array:
    """(count, 4, 4) once round a scene of which no camera is known, a little from above; `size` is its largest side."""
    first = _any_across(up)
    second = np.cross(up, first)
    angle = 2 * np.pi * np.arange(count) / count
    circle = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    return _looking_at(middle + _FROM_OUTSIDE * size * (circle + 0.25 * up), middle, up)


def _focus(world_from_cam: Array, up: Array, scene_depth: float) -> tuple[Array, float, float]:
    """(point nearest to all optical axes, usual horizontal distance to it, usual height above it)."""
    centers, axes = world_from_cam[:, :3, 3], world_from_cam[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # A little pull to the usual depth settles what parallel axes leave open.
    usual = (centers + scene_depth * axes).mean(axis=0)
    matrix = across.sum(axis=0) + 0.05 * len(axes) * np.eye(3)
    focus = np.linalg.solve(matrix, (across @ centers[:, :, None]).sum(axis=0)[:, 0] + 0.05 * len(axes) * usual)
    if np.median(((focus - centers) * axes).sum(axis=1)) < 0.2 * scene_depth:
        focus = usual
    away = centers - focus
    heights = away @ up
    radius = float(np.median(np.linalg.norm(away - heights[:, None] * up, axis=1)))
    return focus, max(radius, 0.3 * scene_depth), float(np.median(heights))


def _any_across(up: Array) -> Array:
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return np.asarray(side / np.linalg.norm(side))


def _looking_at(centers: Array, target: Array, up: Array) -> Array:
    forward = target - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    path = np.tile(np.eye(4), (len(centers), 1, 1))
    path[:, :3, 0], path[:, :3, 1], path[:, :3, 2] = right, np.cross(forward, right), forward
    path[:, :3, 3] = centers
    return path
