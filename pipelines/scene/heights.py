"""Heights in a room: the camera and the ceiling over the floor, tables, seats and beds over it, and doors."""

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected

from ..geometry.room_layout import FLOOR, levels
from ..geometry.room_layout import SURFACE as UNNAMED
from ..labels.named import disputed
from .evidence import (
    CAMERA_OVER_FLOOR,
    CAMERA_OVER_TABLE,
    CEILING_HEIGHT,
    CEILING_OVER_FLOOR,
    DISTANCE,
    DOOR,
    DOORS,
    FLOORS,
    FURNITURE,
    SURFACE,
    TOPS,
    Evidence,
    Mode,
    Sizes,
    measured,
)
from .view import Scene

_UPRIGHT = np.sin(np.radians(20))
_CELL = 3.0
"""Voxels on a side of the cells in which things are separated, seen from above."""
_MIN_TOP, _MIN_DOOR = 60, 100
"""Voxels of a thing's upper side, and of a door: about 0.1 and 0.16 m² at the usual distance."""
_MAX_OF_A_KIND = 4
_OVER_FLOOR = 0.08
"""Whatever is lower than this part of the usual depth is the floor, or on it."""
_MIN_LEVEL = 0.2
"""Share of a thing's upper side that makes a level."""
_LENGTH_SD = 0.04
_WRONG_NAME, _WRONG_SURFACE = 0.3, 0.4
"""Chance that a thing is none, or that its level is another part of it. The small network of the default pull
reaches a mean IoU of 55 % on ADE20K's validation images (MLPerf Mobile)."""

Array = NDArray[np.float64]

_NO_FLOOR, _UNNAMED_FLOOR = 0.03, 0.15
"""The chance that a plane is no floor: where a network calls it one, and where nothing names it."""
_MOSTLY = 0.5
_RISE = 0.6
"""A camera whose height changes by more than this part of itself (80 % of the views) does not stay on one floor."""
_LEVEL = np.cos(np.radians(25))
_GROUND_REACH, _GROUND_SD, _MIN_UNDER, _MIN_OVER_GROUND = 0.3, 0.15, 20, 0.3
"""Ground is within this part of the usual depth around the camera; the height over it is so exact; so many voxels,
and so large a share of the cameras with some under them, are needed."""
_MIN_HEIGHT = 0.05
"""A camera nearer to its floor than this part of the usual depth was put on it: its height says nothing."""


def floor_trust(scene: Scene) -> float | None:
    """The chance that what is lowest is no floor, by the names of its surface; None where they say that it is none."""
    floor = scene.kind == FLOOR
    weight = scene.voxels.weight
    total = float(weight[floor].sum())
    if not total or float(weight[floor & scene.named(FURNITURE)].sum()) > _MOSTLY * total:
        return None
    called = float(weight[floor & scene.named(FLOORS)].sum()) > _MOSTLY * total
    return _NO_FLOOR if called and scene.is_named else _UNNAMED_FLOOR


def camera_height(scene: Scene) -> list[Evidence]:
    """The camera over the floor, or on stairs over the ground: how people hold one; nothing without a floor."""
    wrong, heights = floor_trust(scene), over_floor(scene)
    if wrong is None or len(heights) == 0:
        return []
    length_sd = 0.02
    if not stays_on_floor(heights):
        heights, length_sd = over_ground(scene), _GROUND_SD
        if len(heights) < _MIN_OVER_GROUND * len(scene.centres):
            return []
    height = float(np.median(heights))
    if height < _MIN_HEIGHT * scene.median_depth:
        return []
    held = measured("floor height", "camera height", height, CAMERA_OVER_FLOOR, length_sd=length_sd)
    table_metres, table_sd = CAMERA_OVER_TABLE
    modes = [Mode(m.log_scale, m.sd, m.weight * (1 - wrong)) for m in held.modes]
    modes.append(Mode(float(np.log(table_metres / height)), table_sd, wrong))
    return [Evidence(held.source, held.kind, tuple(modes), 0.03)]


def over_floor(scene: Scene) -> Array:
    """(N,) heights of the cameras over the floor's plane; (0,) without a floor."""
    if scene.floor is None:
        return np.empty(0)
    return np.asarray((scene.centres - scene.floor.point) @ scene.floor.normal)


def stays_on_floor(heights: Array) -> bool:
    """Whether whoever held the camera stayed on one floor: on stairs it rises by more than arms do."""
    low, middle, high = np.quantile(heights, [0.1, 0.5, 0.9])
    return bool(middle > 0 and high - low < _RISE * middle)


def over_ground(scene: Scene) -> Array:
    """(K,) heights of cameras over level ground under them: the way that they went, seen from before or behind."""
    up = scene.gravity.up
    level = scene.voxels.normal @ up > _LEVEL
    ground, reach = scene.voxels.position[level], _GROUND_REACH * scene.median_depth
    heights = []
    for centre in scene.centres:
        from_camera = ground - centre
        depth = -(from_camera @ up)
        sideways = np.linalg.norm(from_camera + depth[:, None] * up, axis=1)
        under = depth[(sideways < reach) & (depth > 0)]
        if len(under) >= _MIN_UNDER:
            heights.append(float(np.quantile(under, 0.6)))
    return np.array(heights)


def ceiling_height(scene: Scene) -> list[Evidence]:
    """The ceiling over the floor; nothing unless both are seen."""
    floor, ceiling, wrong = scene.floor, scene.ceiling, floor_trust(scene)
    if floor is None or ceiling is None or wrong is None:
        return []
    height = float((ceiling.point - floor.point) @ floor.normal)
    if height <= 0:
        return []
    return [
        measured("ceiling height", CEILING_HEIGHT, height, CEILING_OVER_FLOOR, wrong=max(wrong, 0.1), length_sd=0.02)
    ]


def usual_distance(scene: Scene) -> Evidence:
    """Return the evidence of usual distances in a video of a room: weak, and always available."""
    return measured("usual distances", "distance", scene.median_depth, DISTANCE, wrong=0.02)


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
    for name, (label, sizes) in TOPS.items():
        for members in _instances(scene, above & scene.named((name,)), _MIN_TOP):
            found = _levels(scene, heights, members)
            if found:
                known[label].append((found[0], sizes))
    return [
        measured(label, label, height, sizes, wrong=_WRONG_NAME, length_sd=_LENGTH_SD)
        for label, things in known.items()
        for height, sizes in things[:_MAX_OF_A_KIND]
    ]


def _doors(scene: Scene, heights: Array, upward: Array) -> list[Evidence]:
    """Upper ends of upright surfaces that are called doors and begin at the floor."""
    upright = (np.abs(upward) < _UPRIGHT) & scene.named(DOORS)
    found = []
    for members in _instances(scene, upright, _MIN_DOOR)[:_MAX_OF_A_KIND]:
        low, high = np.quantile(heights[members], [0.03, 0.97])
        if high > 0 and low < 0.15 * high:  # a mirror shows doors under the floor too
            found.append(measured("door", "door", float(high), DOOR, wrong=_WRONG_NAME, length_sd=0.06))
    return found


def _surfaces(scene: Scene, heights: Array) -> list[Evidence]:
    """Level surfaces over the floor where nothing has a name: all together, as one kind."""
    members = scene.kind == UNNAMED
    if members.sum() < _MIN_TOP:
        return []
    found = _levels(scene, heights, members)
    return [
        measured("level surface", "surface", height, SURFACE, wrong=_WRONG_SURFACE, length_sd=_LENGTH_SD)
        for height in found[:_MAX_OF_A_KIND]
        if height > _OVER_FLOOR * scene.median_depth
    ]


def _levels(scene: Scene, heights: Array, members: NDArray) -> list[float]:
    """Heights with many of these voxels, most first."""
    weight = scene.voxels.weight[members]
    return levels(heights[members], weight / weight.sum(), scene.voxels.size, _MIN_LEVEL)


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
