"""Heights in a room: the camera over the floor, and the ceiling over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.room_layout import FLOOR
from .evidence import Evidence, Mode, measured
from .sizes import CAMERA_OVER_FLOOR, CAMERA_OVER_TABLE, CEILING_OVER_FLOOR, DISTANCE, FLOORS, FURNITURE
from .view import Scene

Array = NDArray[np.float64]

_NO_FLOOR, _UNNAMED_FLOOR = 0.03, 0.15
"""The chance that a plane is no floor: where a network calls it one, and where nothing names it."""
_MOSTLY = 0.5
_RISE = 0.6
"""A camera whose height changes by more than this part of itself (80 % of the views) does not stay on one floor."""
_LEVEL = np.cos(np.radians(25))
_GROUND_REACH, _GROUND_SD, _LEAST_UNDER, _LEAST_OVER_GROUND = 0.3, 0.15, 20, 0.3
"""Ground is within this part of the usual depth around the camera; the height over it is so exact; so many voxels,
and so large a share of the cameras with some under them, are needed."""
_LEAST_HEIGHT = 0.05
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
        if len(heights) < _LEAST_OVER_GROUND * len(scene.centres):
            return []
    height = float(np.median(heights))
    if height < _LEAST_HEIGHT * scene.median_depth:
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
        if len(under) >= _LEAST_UNDER:
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
    return [measured("ceiling height", "ceiling", height, CEILING_OVER_FLOOR, wrong=max(wrong, 0.1), length_sd=0.02)]


def usual_distance(scene: Scene) -> Evidence:
    """Return the evidence of usual distances in a video of a room: weak, and always available."""
    return measured("usual distances", "distance", scene.median_depth, DISTANCE, wrong=0.02)
