"""The room that the keyframes saw, as voxels with classes, and heights in it that tell how long a metre is: the camera
and the ceiling over the floor, tables, seats and beds over it, and doors."""

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label as connected

from ..geometry.camera import resize_maps, unproject_depth
from ..geometry.sequence import resize_area
from ..geometry.voxels import (
    CEILING,
    FLOOR,
    MIN_WEIGHT,
    VOXELS_PER_DEPTH,
    FloorPlane,
    Gravity,
    Voxels,
    find,
    find_gravity,
    floor_plane,
    gather_frame,
    levels,
    merge,
    name_structure,
    voxel_keys,
)
from ..geometry.voxels import SURFACE as UNNAMED
from ..labels.named import disputed
from ..types import VOID, Array, Intrinsics, ProxyMaps
from . import evidence
from .evidence import Evidence, Mode, Sizes, measured

MIN_CONFIDENCE = 0.3
_SIDE = 200
_MIN_PLANE = 30
"""Voxels without which a floor or a ceiling is none."""


@dataclass(frozen=True)
class SeenFrame:
    """One keyframe: its image (H, W, 3), its maps with depth in the unit of the world, world_from_cam (4, 4)."""

    image: NDArray[np.uint8]
    maps: ProxyMaps
    world_from_cam: Array


@dataclass(frozen=True)
class Scene:
    """kind (V,): floor, ceiling, … by `name_structure`; label (V,) class of each voxel or VOID; names of the classes;
    centres (N, 3) of the cameras; median_depth of what they see. `is_named`: whether something that knows things gave
    the names, and not the geometry."""

    voxels: Voxels
    gravity: Gravity
    kind: NDArray[np.int64]
    label: NDArray[np.uint8]
    names: tuple[str, ...]
    centres: Array
    median_depth: float
    is_named: bool = True

    def named(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """(V,) voxels whose class has one of these names."""
        wanted = [i for i, name in enumerate(self.names) if name.lower() in names]
        return np.isin(self.label, wanted)

    def plane(self, kind: int) -> FloorPlane | None:
        """Fit the plane of the floor or the ceiling; None where too little of it was seen."""
        if (self.kind == kind).sum() < _MIN_PLANE:
            return None
        return floor_plane(self.voxels, self.kind, self.gravity.up, kind)

    @property
    def floor(self) -> FloorPlane | None:
        return self.plane(FLOOR)

    @property
    def ceiling(self) -> FloorPlane | None:
        return self.plane(CEILING)


def build_scene(
    frames: Sequence[SeenFrame], intrinsics: Intrinsics, names: tuple[str, ...], is_named: bool
) -> Scene | None:
    """The scene of some keyframes; None where none of them has reliable depth."""
    known = [f.maps.depth[(f.maps.depth > 0) & (f.maps.confidence >= MIN_CONFIDENCE)][::7] for f in frames]
    if not sum(map(len, known)):
        return None
    median_depth = float(np.median(np.concatenate(known)))
    size = median_depth / VOXELS_PER_DEPTH
    camera = intrinsics.at_most(_SIDE)
    rows = [_gather(f, camera, size) for f in frames]
    # Votes are by the same cubes, however many.
    voxels = merge(size, [(keys, values) for keys, values, _ in rows], sys.maxsize, MIN_WEIGHT)
    cameras = np.array([f.world_from_cam for f in frames])
    gravity = find_gravity(voxels, -cameras[:, :3, 1].mean(0))
    kind = name_structure(voxels, gravity, cameras[:, :3, 3])
    label = _vote(voxels, [votes for _, _, votes in rows])
    return Scene(voxels, gravity, kind, label, names, cameras[:, :3, 3], median_depth, is_named)


def _gather(
    frame: SeenFrame, camera: Intrinsics, size: float
) -> tuple[NDArray[np.int64], Array, tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """The frame's voxels as `gather_frame` gives them, and (Q,) key and label of each of its reliable pixels."""
    maps, motion = resize_maps(frame.maps, camera.height, camera.width), frame.world_from_cam
    sure = maps.confidence >= MIN_CONFIDENCE
    weight = np.where(sure, maps.confidence, 0).astype(np.float32)
    image = resize_area(frame.image, camera.width, camera.height)
    keys, values = gather_frame(maps.depth, weight, image, camera, motion, size)
    use = sure & (maps.depth > 0) & (maps.labels != VOID)
    points = unproject_depth(maps.depth, camera)[use] @ motion[:3, :3].T + motion[:3, 3]
    return keys, values, (voxel_keys(points, size), maps.labels[use])


def _vote(voxels: Voxels, votes: Sequence[tuple[NDArray[np.int64], NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """(V,) the label that most pixels of each voxel have; VOID for a voxel without any."""
    label = np.full(len(voxels), VOID, np.uint8)
    if not len(voxels) or not votes:
        return label
    at = find(voxels.keys, np.concatenate([keys for keys, _ in votes]))
    given = np.concatenate([labels for _, labels in votes])
    said, counts = np.unique(at[at >= 0] * 256 + given[at >= 0], return_counts=True)
    # The most last, of as many the first label.
    order = np.lexsort((-said, counts))
    label[said[order] // 256] = said[order] % 256
    return label


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

_NO_FLOOR = 0.15
"""The chance that the lowest plane is no floor: of nine recordings with one, it was a desk once. That it is called
one does not count: names by shape go by heights over it."""
_MOSTLY = 0.5
_RISE = 0.6
"""A camera whose height changes by more than this part of itself (80 % of the views) does not stay on one floor."""
_LEVEL = np.cos(np.radians(25))
_MIN_HEIGHT = 0.05
"""A camera nearer to its floor than this part of the usual depth was put on it: its height says nothing."""


def may_have_floor(scene: Scene) -> bool:
    """Whether what is lowest is not mostly called furniture."""
    floor, weight = scene.kind == FLOOR, scene.voxels.weight
    furniture = floor & scene.named(evidence.FURNITURE)
    return float(weight[furniture].sum()) < _MOSTLY * float(weight[floor].sum())


def camera_height(scene: Scene) -> list[Evidence]:
    """The camera over the floor: how people hold one; nothing without a floor, or on stairs."""
    heights = over_floor(scene)
    if not may_have_floor(scene) or len(heights) == 0 or not stays_on_floor(heights):
        return []
    height = float(np.median(heights))
    if height < _MIN_HEIGHT * scene.median_depth:
        return []
    held = measured("floor height", "camera height", height, evidence.CAMERA_OVER_FLOOR, length_sd=0.02)
    table_metres, table_sd = evidence.CAMERA_OVER_TABLE
    modes = [Mode(m.log_scale, m.sd, m.weight * (1 - _NO_FLOOR)) for m in held.modes]
    modes.append(Mode(float(np.log(table_metres / height)), table_sd, _NO_FLOOR))
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


def ceiling_height(scene: Scene) -> list[Evidence]:
    """The ceiling over the floor; nothing unless both are seen."""
    floor, ceiling = scene.floor, scene.ceiling
    if floor is None or ceiling is None or not may_have_floor(scene):
        return []
    height = float((ceiling.point - floor.point) @ floor.normal)
    if height <= 0:
        return []
    kind, sizes = evidence.CEILING_HEIGHT, evidence.CEILING_OVER_FLOOR
    return [measured("ceiling height", kind, height, sizes, wrong=_NO_FLOOR, length_sd=0.02)]


def usual_distance(scene: Scene) -> Evidence:
    """Return the evidence of usual distances in a video of a room: weak, and always available."""
    return measured("usual distances", "distance", scene.median_depth, evidence.DISTANCE, wrong=0.02)


def sizes_of_things(scene: Scene) -> list[Evidence]:
    """Evidence of all things of known size; nothing without one floor, from which all of them are measured."""
    if scene.floor is None or not may_have_floor(scene) or not stays_on_floor(over_floor(scene)):
        return []
    heights = (scene.voxels.position - scene.floor.point) @ scene.floor.normal
    upward = scene.voxels.normal @ scene.floor.normal
    # Names by shape alone go by heights themselves.
    named = _tops(scene, heights, upward) + _doors(scene, heights, upward) if scene.is_named else []
    return named or _surfaces(scene, heights)


def _tops(scene: Scene, heights: Array, upward: Array) -> list[Evidence]:
    """Upper sides of things with a name that their parts agree on."""
    above = (upward > _LEVEL) & (heights > _OVER_FLOOR * scene.median_depth)
    above &= ~disputed(scene.label, scene.names, scene.voxels)
    known: dict[str, list[tuple[float, Sizes]]] = defaultdict(list)
    for name, (label, sizes) in evidence.TOPS.items():
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
    upright = (np.abs(upward) < _UPRIGHT) & scene.named(evidence.DOORS)
    found = []
    for members in _instances(scene, upright, _MIN_DOOR)[:_MAX_OF_A_KIND]:
        low, high = np.quantile(heights[members], [0.03, 0.97])
        if high > 0 and low < 0.15 * high:  # a mirror shows doors under the floor too
            found.append(measured("door", "door", float(high), evidence.DOOR, wrong=_WRONG_NAME, length_sd=0.06))
    return found


def _surfaces(scene: Scene, heights: Array) -> list[Evidence]:
    """Level surfaces over the floor where nothing has a name: all together, as one kind."""
    members = scene.kind == UNNAMED
    if members.sum() < _MIN_TOP:
        return []
    found = _levels(scene, heights, members)
    return [
        measured("level surface", "surface", height, evidence.SURFACE, wrong=_WRONG_SURFACE, length_sd=_LENGTH_SD)
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
    plan = scene.voxels.position[index] @ np.linalg.svd(scene.floor.normal[None])[2][1:].T
    cell = np.floor((plan - plan.min(0)) / (_CELL * scene.voxels.size)).astype(np.int64)
    occupied = np.zeros(cell.max(0) + 1, bool)
    occupied[cell[:, 0], cell[:, 1]] = True
    numbers, count = connected(occupied, np.ones((3, 3)))
    of_voxel = numbers[cell[:, 0], cell[:, 1]]
    things = [index[of_voxel == n] for n in range(1, count + 1)]
    return sorted((t for t in things if len(t) >= least), key=len, reverse=True)
