"""Floor, ceiling, walls and table tops of a room, from the normals and heights of its surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .voxels import Voxels

OTHER, FLOOR, CEILING, WALL, SURFACE = range(5)
NAMES = {FLOOR: "floor", CEILING: "ceiling", WALL: "wall", SURFACE: "surface"}

_HORIZONTAL = np.cos(np.radians(25))
_VERTICAL = np.sin(np.radians(20))
_MIN_SHARE = 0.015
"""A plane with a smaller share of all surface is not named."""
_BEYOND_SHARE = 0.03
"""Behind a wall, under a floor, over a ceiling there is at most this share of the surface."""


@dataclass(frozen=True)
class Gravity:
    """up (3,) unit vector in the world; `is_sure` when a dominant plane confirms the cameras' own up."""

    up: NDArray[np.float64]
    is_sure: bool


def find_gravity(voxels: Voxels, cam_up: NDArray[np.float64]) -> Gravity:
    """Find up: the normal direction of the most surface within 40° of the cameras' mean up `cam_up` (people hold
    cameras upright). Opposite normals (floor and ceiling) count as the same direction. Without any surface there, the
    cameras' up, unsure."""
    cam_up = cam_up / max(float(np.linalg.norm(cam_up)), 1e-12)
    along = voxels.normal @ cam_up
    near = np.abs(along) > np.cos(np.radians(40))
    if voxels.weight[near].sum() <= 0.03 * voxels.weight.sum():
        return Gravity(cam_up, False)
    normals = voxels.normal[near] * np.sign(along[near])[:, None]
    weight = voxels.weight[near]
    up = normals[int(_support(normals, weight).argmax())]
    for _ in range(5):
        close = normals @ up > np.cos(np.radians(8))
        up = (normals[close] * weight[close, None]).sum(0)
        up = up / np.linalg.norm(up)
    share = weight[normals @ up > np.cos(np.radians(8))].sum() / voxels.weight.sum()
    return Gravity(up, bool(share > 2 * _MIN_SHARE))


def _support(normals: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight within 8° of a sample of the normals; 0 for those not sampled."""
    support = np.zeros(len(normals))
    for i in np.linspace(0, len(normals) - 1, min(len(normals), 400)).astype(np.int64):
        support[i] = weight[normals @ normals[i] > np.cos(np.radians(8))].sum()
    return support


def name_structure(voxels: Voxels, gravity: Gravity, cameras: NDArray[np.float64]) -> NDArray[np.int64]:
    """(V,) OTHER, FLOOR, CEILING, WALL or SURFACE of every voxel; `cameras` (N, 3) are the camera centres."""
    kind = np.full(len(voxels), OTHER, np.int64)
    if not gravity.is_sure:
        return kind
    height = voxels.position @ gravity.up
    upward = voxels.normal @ gravity.up
    eye = float(np.median(cameras @ gravity.up))
    thick = 2.5 * voxels.size
    share = voxels.weight / voxels.weight.sum()
    for level in levels(height, share * (upward > _HORIZONTAL), voxels.size):
        members = (upward > _HORIZONTAL) & (np.abs(height - level) < thick)
        is_lowest = share[height < level - 2 * thick].sum() < _BEYOND_SHARE
        kind[members & (kind == OTHER)] = FLOOR if is_lowest and level < eye else SURFACE
    for level in levels(height, share * (upward < -_HORIZONTAL), voxels.size):
        members = (upward < -_HORIZONTAL) & (np.abs(height - level) < thick)
        if share[height > level + 2 * thick].sum() < _BEYOND_SHARE and level > eye:
            kind[members] = CEILING
    _name_walls(voxels, gravity.up, share, upward, kind)
    return kind


@dataclass(frozen=True)
class FloorPlane:
    """`normal` (3,) unit vector upwards, and a `point` (3,) of the floor or the ceiling, in the world."""

    normal: NDArray[np.float64]
    point: NDArray[np.float64]


def floor_plane(
    voxels: Voxels, kinds: NDArray[np.int64], up: NDArray[np.float64], kind: int = FLOOR
) -> FloorPlane | None:
    """Fit the plane of the voxels that `name_structure` called floor (or CEILING, for `kind`); None without any.

    Up by normals is good to a degree or two, which is centimetres at the feet: the floor's own plane is exact.
    """
    floor, share = voxels.position[kinds == kind], voxels.weight[kinds == kind]
    if len(floor) < 3:
        return None
    weight = share
    for _ in range(5):
        middle = np.average(floor, 0, weight)
        normal = np.linalg.eigh((floor - middle).T @ ((floor - middle) * weight[:, None]))[1][:, 0]
        normal *= np.sign(normal @ up)
        off = np.abs((floor - middle) @ normal)
        weight = share / (1 + (off / (np.median(off) + 1e-12)) ** 2)
    return FloorPlane(normal, middle)


def levels(
    value: NDArray[np.float64], share: NDArray[np.float64], size: float, least: float = _MIN_SHARE
) -> list[float]:
    """Peaks of a histogram of `value` weighted by `share`, largest first, each with at least the share `least`."""
    if share.sum() < least:
        return []
    low = value.min() - 4 * size
    bins = np.bincount(((value - low) / size).astype(np.int64), weights=share)
    smooth = np.convolve(bins, np.ones(5), mode="same")
    found = []
    while smooth.max() >= least:
        peak = int(smooth.argmax())
        span = slice(max(peak - 2, 0), peak + 3)
        center = (np.arange(len(bins))[span] * bins[span]).sum() / bins[span].sum()
        found.append(float(low + (center + 0.5) * size))
        bins[max(peak - 4, 0) : peak + 5] = 0
        smooth = np.convolve(bins, np.ones(5), mode="same")
    return found


def _name_walls(
    voxels: Voxels,
    up: NDArray[np.float64],
    share: NDArray[np.float64],
    upward: NDArray[np.float64],
    kind: NDArray[np.int64],
) -> None:
    """Vertical planes with much surface and almost nothing behind them."""
    upright = (np.abs(upward) < _VERTICAL) & (kind == OTHER)
    left = upright.copy()
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    for _ in range(12):
        azimuth = np.arctan2(voxels.normal @ second, voxels.normal @ first)
        bins = np.bincount(((azimuth[left] + np.pi) / (2 * np.pi) * 72).astype(np.int64) % 72, share[left], 72)
        smooth = bins + np.roll(bins, 1) + np.roll(bins, -1)
        if smooth.max() < _MIN_SHARE:
            return
        angle = (int(smooth.argmax()) + 0.5) / 72 * 2 * np.pi - np.pi
        facing = left & (np.cos(azimuth - angle) > np.cos(np.radians(12)))
        normal = (voxels.normal[facing] * share[facing, None]).sum(0)
        normal -= up * (normal @ up)
        normal /= np.linalg.norm(normal)
        offset = voxels.position @ normal
        for level in levels(offset, share * facing, voxels.size):
            plane = facing & (np.abs(offset - level) < 2.5 * voxels.size)
            if share[offset < level - 5 * voxels.size].sum() < _BEYOND_SHARE:
                kind[plane] = WALL
        left &= ~facing
