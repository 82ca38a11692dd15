"""Sizes of things: how high tables, seats and beds are over the floor, and how high doors are."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected

from ..geometry.room_layout import SURFACE as UNNAMED
from ..geometry.room_layout import levels
from ..labels.belonging import disputed
from .evidence import Evidence, measured
from .heights import floor_trust, over_floor, stays_on_floor
from .sizes import DOOR, DOORS, SURFACE, TOPS, Sizes
from .view import Scene

Array = NDArray[np.float64]

_LEVEL = np.cos(np.radians(25))
_UPRIGHT = np.sin(np.radians(20))
_CELL = 3.0
"""Voxels on a side of the cells in which things are separated, seen from above."""
_LEAST_TOP, _LEAST_DOOR = 60, 100
"""Voxels of a thing's upper side, and of a door: about 0.1 and 0.16 m² at the usual distance."""
_MOST_OF_A_KIND = 4
_OVER_FLOOR = 0.08
"""Whatever is lower than this part of the usual depth is the floor, or on it."""
_LEAST_LEVEL = 0.2
"""Share of a thing's upper side that makes a level."""
_LENGTH_SD = 0.04
_WRONG_NAME, _WRONG_SURFACE = 0.3, 0.4
"""Chance that a thing is none, or that its level is another part of it. The small network of the default pull
reaches a mean IoU of 55 % on ADE20K's validation images (MLPerf Mobile)."""


def sizes_of_things(scene: Scene) -> list[Evidence]:
    """Evidence of all things of known size; nothing without one floor, from which all of them are measured."""
    if scene.floor is None or floor_trust(scene) is None or not stays_on_floor(over_floor(scene)):
        return []
    heights = (scene.voxels.position - scene.floor.point) @ scene.floor.normal
    upward = scene.voxels.normal @ scene.floor.normal
    named = _tops(scene, heights, upward) + _doors(scene, heights, upward)
    return named or _surfaces(scene, heights)


def _tops(scene: Scene, heights: Array, upward: Array) -> list[Evidence]:
    """Upper sides of things with a name that their parts agree on."""
    above = (upward > _LEVEL) & (heights > _OVER_FLOOR * scene.median_depth)
    above &= ~disputed(scene.label, scene.names, scene.voxels)
    known: dict[str, list[tuple[float, Sizes]]] = defaultdict(list)
    for name, (told, sizes) in TOPS.items():
        for members in _instances(scene, above & scene.named((name,)), _LEAST_TOP):
            found = _levels(scene, heights, members)
            if found:
                known[told].append((found[0], sizes))
    return [
        measured(told, told, height, sizes, wrong=_WRONG_NAME, length_sd=_LENGTH_SD)
        for told, things in known.items()
        for height, sizes in things[:_MOST_OF_A_KIND]
    ]


def _doors(scene: Scene, heights: Array, upward: Array) -> list[Evidence]:
    """Upper ends of upright surfaces that are called doors and begin at the floor."""
    upright = (np.abs(upward) < _UPRIGHT) & scene.named(DOORS)
    found = []
    for members in _instances(scene, upright, _LEAST_DOOR)[:_MOST_OF_A_KIND]:
        low, high = np.quantile(heights[members], [0.03, 0.97])
        if high > 0 and low < 0.15 * high:  # a mirror shows doors under the floor too
            found.append(measured("door", "door", float(high), DOOR, wrong=_WRONG_NAME, length_sd=0.06))
    return found


def _surfaces(scene: Scene, heights: Array) -> list[Evidence]:
    """Level surfaces over the floor where nothing has a name: all together, as one kind."""
    members = scene.kind == UNNAMED
    if members.sum() < _LEAST_TOP:
        return []
    found = _levels(scene, heights, members)
    return [
        measured("level surface", "surface", height, SURFACE, wrong=_WRONG_SURFACE, length_sd=_LENGTH_SD)
        for height in found[:_MOST_OF_A_KIND]
        if height > _OVER_FLOOR * scene.median_depth
    ]


def _levels(scene: Scene, heights: Array, members: NDArray) -> list[float]:
    """Heights with many of these voxels, most first."""
    weight = scene.voxels.weight[members]
    return levels(heights[members], weight / weight.sum(), scene.voxels.size, _LEAST_LEVEL)


def _instances(scene: Scene, members: NDArray[np.bool_], least: int) -> list[NDArray[np.int64]]:
    """Indices of the voxels of each thing, largest first: those that touch, seen from above."""
    index = np.flatnonzero(members)
    if len(index) < least or scene.floor is None:
        return []
    up = scene.floor.normal
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    plan = scene.voxels.position[index] @ np.stack([first, np.cross(up, first)], 1)
    cell = np.floor((plan - plan.min(0)) / (_CELL * scene.voxels.size)).astype(np.int64)
    occupied = np.zeros(cell.max(0) + 1, bool)
    occupied[cell[:, 0], cell[:, 1]] = True
    numbers, count = connected(occupied, np.ones((3, 3)))
    of_voxel = numbers[cell[:, 0], cell[:, 1]]
    things = [index[of_voxel == n] for n in range(1, count + 1)]
    return sorted((t for t in things if len(t) >= least), key=len, reverse=True)
