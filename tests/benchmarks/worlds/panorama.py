"""Panoramas of a world: every pixel's own rays, with exact truth."""

import numpy as np
from numpy.typing import NDArray

from tests.world.build import World
from tests.world.cast import render_rays
from tests.world.clip import ClipOptions, develop

_BLOCK = 32


def render_panorama(
    world: World, world_from_cam: NDArray[np.float64], width: int, supersampling: int = 2
) -> NDArray[np.uint8]:
    """(width / 2, width, 3) equirectangular: the camera looks at the middle, the upper rim is its up.

    Block by block, each by a pinhole camera that looks at the block's middle: the caster knows no other rays.
    """
    height = width // 2
    color = np.zeros((height, width, 3), np.float32)
    for top in range(0, height, _BLOCK):
        for left in range(0, width, _BLOCK):
            bottom, right = min(top + _BLOCK, height), min(left + _BLOCK, width)
            color[top:bottom, left:right] = _block(
                world, world_from_cam, (top, bottom, left, right), width, supersampling
            )
    return develop(color, ClipOptions(frames=1, width=width, height=height), 0)


def _block(
    world: World, world_from_cam: NDArray[np.float64], at: tuple[int, int, int, int], width: int, n: int
) -> NDArray[np.float32]:
    top, bottom, left, right = at
    ahead = _directions(np.array((top + bottom) / 2), np.array((left + right) / 2), width)
    aside = np.cross([0.0, 1, 0] if abs(ahead[1]) < 0.9 else [0.0, 0, 1], ahead)
    aside /= np.linalg.norm(aside)
    block_from_cam = np.stack([aside, np.cross(ahead, aside), ahead])
    rows, columns = np.meshgrid(np.arange(top, bottom), np.arange(left, right), indexing="ij")
    inner = (np.arange(n) + 0.5) / n
    down, across = (x.ravel() for x in np.meshgrid(inner, inner, indexing="ij"))
    rays = _directions(rows[..., None] + down, columns[..., None] + across, width) @ block_from_cam.T
    middles = _directions(rows + 0.5, columns + 0.5, width) @ block_from_cam.T
    pose = world_from_cam.copy()
    pose[:3, :3] = world_from_cam[:3, :3] @ block_from_cam.T
    color = np.zeros((*rows.shape, 3), np.float32)
    depth, solid_at = np.zeros(rows.shape, np.float32), np.empty(rows.shape, np.int32)
    a, solids = world.atlas, world.solids
    render_rays(
        pose, np.ascontiguousarray(middles[..., :2] / middles[..., 2:]),
        np.ascontiguousarray(rays[..., :2] / rays[..., 2:]), 2 * np.pi / width / n, *solids.arguments,
        solids.first_face, a.codes, a.levels, a.level_count, a.texel, color, depth, solid_at,
    )  # fmt: skip
    return color


def _directions(row: NDArray, column: NDArray, width: int) -> NDArray[np.float64]:
    """(..., 3) where places of the picture look, in the camera."""
    longitude, latitude = (column / width - 0.5) * 2 * np.pi, (0.5 - 2 * row / width) * np.pi
    level = np.cos(latitude)
    return np.stack([np.sin(longitude) * level, -np.sin(latitude), np.cos(longitude) * level], axis=-1)
