"""The world of the exported files: its up and its floor, found in a finished run, and the transform from the run's own.

A line in an image and the camera's centre span a plane. The direction of the line in the world lies in that plane, so
the plane's normal n is across it: n . up = 0 for every upright line, whatever its place. With the cameras' rotations
known, the lines of all images vote together (the vanishing point of all cameras at once).
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.posed_depth import PosedDepth
from ..geometry.se3 import Similarity
from ..geometry.voxels import (
    VOXELS_PER_DEPTH,
    Gravity,
    Voxels,
    find_gravity,
    floor_plane,
    gather_depths,
    name_structure,
)
from ..mapping.measure import depth_view
from ..run.outcome import Outcome, maps_around, spread_sample
from ..run.schema import RunFile
from ..system.parallel import map_lookahead, parallel_map
from ..system.threads import get_threads, host_threads
from ..system.values import dataclass_from_json
from ..types import Array, Intrinsics

SAME = Similarity(1.0, np.eye(3), np.zeros(3))
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""glTF's axes (y up, z towards the viewer) from those of the exported world."""
_Y_DOWN_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
Z_UP_FROM_Y_DOWN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Axes of a world that stands from x right, y down, z forward."""


@dataclass(frozen=True)
class Georeference:
    """origin (3,) latitude, longitude, altitude of (0, 0, 0); x is east, y north. `residual`: metres, root mean square
    of a horizontal coordinate over the `used` of `fixes`; `scale_sd`: relative standard deviation of the scale."""

    origin: tuple[float, float, float]
    residual: float
    used: int
    fixes: int
    scale_sd: float


@dataclass(frozen=True)
class World:
    """axes "up" (z up) or "first" (the run's own); the source of up ("" without any), whether z = 0 is a floor, and
    by how many degrees each other witness of up differs; `earth`: its place, if x is east and y is north; `unit`:
    "metre" or "free"."""

    axes: str
    source: str
    has_floor: bool
    exported_from_run: Similarity
    disagreement_deg: dict[str, float] = field(default_factory=dict)
    earth: Georeference | None = None
    unit: str = "free"

    @property
    def gltf_from_exported(self) -> Array:
        """(3, 3) rotation into glTF's y up; identity where the world is not upright."""
        return Y_UP_FROM_Z_UP if self.axes == "up" else np.eye(3)

    @property
    def image_axes_from_exported(self) -> Array:
        """(3, 3) rotation into x right, y down, z forward: the axes of splat files, and of what they are trained on."""
        return _Y_DOWN_FROM_Z_UP if self.axes == "up" else np.eye(3)


FIRST = World("first", "", False, SAME)


def in_world(outcome: Outcome, world: World) -> Outcome:
    """Return the outcome as the exported files show it. On the Earth they are in metres: there is nothing to multiply.

    Raises ValueError for one that has been moved before.
    """
    moved = outcome.moved(world.exported_from_run)
    return moved if world.earth is None else replace(moved, metric=True, metres=None)


@dataclass(frozen=True)
class Upright:
    """`up` (3,) unit vector in the run's world and its source, "" where none; `floor` (3,) a point of the
    floor, None without one; `disagreement_deg`: degrees between up and what each witness says alone."""

    up: Array
    source: str
    floor: Array | None
    disagreement_deg: dict[str, float] = field(default_factory=dict)


def upright_world(outcome: Outcome, found: Upright) -> World:
    """z up, the floor at 0, x and y counted from the middle of the camera's path; y is where the first camera looked.

    Without a floor z counts from the middle of the path too. `FIRST` where up is unknown.
    """
    if not found.source:
        return FIRST
    trajectory = outcome.trajectory
    world_from_cam = trajectory.world_from_cam[trajectory.is_posed]
    rotation = _level_axes(found.up, world_from_cam[0])
    middle = rotation @ world_from_cam[:, :3, 3].mean(axis=0)
    if found.floor is not None:
        middle[2] = (rotation @ found.floor)[2]
    return World(
        "up", found.source, found.floor is not None, Similarity(1.0, rotation, -middle), found.disagreement_deg
    )


def _level_axes(up: Array, world_from_cam: Array) -> Array:
    """(3, 3) exported_from_run: rows x, y, z; y is the level part of the camera's view (of its up if it looks down)."""
    forward = world_from_cam[:3, 2]
    if abs(forward @ up) > 0.95:
        forward = -world_from_cam[:3, 1] * np.sign(-(forward @ up))
    y = forward - (forward @ up) * up
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, up), y, up])


def world_figures(world: World) -> dict[str, Any]:
    """For the table of the run."""
    figures = {"up": world.source or "unknown", "floor": world.has_floor, "degrees_from_up": world.disagreement_deg}
    if world.earth is not None:
        e = world.earth
        figures["gps"] = {"used": e.used, "of": e.fixes, "residual_m": e.residual, "scale_relative_sd": e.scale_sd}
    return figures


def _pack(world: World) -> dict[str, Any]:
    """What the axes mean, how sure, and exported = scale * rotation @ run + translation."""
    move = world.exported_from_run
    return {
        "axes": world.axes,
        "up": "z" if world.axes == "up" else "unknown",
        "up_source": world.source,
        "floor_at_zero": world.has_floor,
        "unit": world.unit,
        "splats_from_exported": world.image_axes_from_exported.tolist(),
        "degrees_from_up": world.disagreement_deg,
        **({} if world.earth is None else {"georeference": asdict(world.earth) | {"frame": "east north up"}}),
        "exported_from_run": {
            "scale": move.scale, "rotation": move.rotation.tolist(), "translation": move.translation.tolist()
        },
    }  # fmt: skip


def _unpack(value: Any) -> World:
    move, earth = value["exported_from_run"], value.get("georeference")
    rotation, translation = (np.array(move[name], dtype=np.float64) for name in ("rotation", "translation"))
    return World(
        axes=str(value["axes"]),
        source=str(value.get("up_source", "")),
        has_floor=bool(value["floor_at_zero"]),
        exported_from_run=Similarity(float(move["scale"]), rotation, translation),
        disagreement_deg={str(name): float(v) for name, v in value["degrees_from_up"].items()},
        earth=earth and dataclass_from_json(Georeference, {k: earth[k] for k in earth if k != "frame"}),
        unit=str(value["unit"]),
    )


WORLD: RunFile[World] = RunFile("world.json", ("export",), "world of the exported files", _unpack, _pack)
"""The world of the files in the run's export; none where nothing, or an older version, has exported it."""


def up_in_run(outcome: Outcome) -> Array:
    """(3,) up in the run's world: as it was exported, else as the cameras were held."""
    world = outcome.run.find(WORLD)
    if world is not None and world.axes == "up":
        return np.asarray(world.exported_from_run.rotation[2])
    trajectory = outcome.trajectory
    return cameras_up(trajectory.world_from_cam[trajectory.is_posed])


_MIN_LENGTH = 0.05
"""Shorter segments, as a share of the image's long side, have no reliable direction."""
_REACH = 35.0
_PRIOR_SD = 15.0
"""Degrees by which the cameras' own up is wrong: phones are held at a slant, and one direction of view leaves its tilt
open. The prior chooses among the directions of a room, it does not bend the one it chooses."""
_COARSE_SD = 1.5
_SDS = (2.0, 1.0, 0.7, 0.5, 0.5, 0.5)
_INSIDE = 1.0
_MIN_LINES = 40
_MIN_CONTRAST = 3.0

_PICTURES, _VIEWS = 40, 24
_SIDE = 200
_AGREE = 3.0
"""Degrees: a floor that leans more against sure upright lines is a ramp, or badly seen; the lines are believed."""


def cameras_up(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) unit vector across the cameras' right axes, which people hold level, on the side of their upward axes.

    world_from_cam (N, 4, 4), at least one.
    """
    right = world_from_cam[:, :3, 0]
    # Alone, the mean upward axis leans as the cameras look down; the little weight settles what one direction of view
    # leaves open.
    up = np.linalg.solve(right.T @ right / len(right) + 0.01 * np.eye(3), -world_from_cam[:, :3, 1].mean(axis=0))
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))


def find_upright(outcome: Outcome) -> Upright:
    """Up by the floor's plane, upright lines or level surfaces, the surest there is.

    The cameras' own up only chooses among the directions of a room: alone it is no evidence, since a phone is held as
    it pleases.
    """
    trajectory = outcome.trajectory
    prior = cameras_up(trajectory.world_from_cam[trajectory.is_posed])
    rows = spread_sample(np.flatnonzero(trajectory.is_keyframe).tolist(), _PICTURES)
    poses = trajectory.cam_from_world[rows]
    pictures = (outcome.run.image(outcome.frames[row]) for row in rows)
    lines = up_of_lines(pictures, poses, outcome.calibration.intrinsics, prior, get_threads())
    voxels = surface_voxels(outcome, spread_sample(rows, _VIEWS))
    level = find_gravity(voxels, prior) if len(voxels) else Gravity(prior, False)
    if not (lines.is_sure or level.is_sure):
        return Upright(prior, "", None)
    first = lines.up if lines.is_sure else level.up
    kinds = name_structure(voxels, Gravity(first, True), trajectory.centers[trajectory.is_posed])
    floor = floor_plane(voxels, kinds, first)
    witnesses = {"cameras": prior, "level surfaces": level.up}
    witnesses |= {"upright lines": lines.up} if lines.is_sure else {}
    witnesses |= {"floor": floor.normal} if floor else {}
    up, source = _verdict(witnesses)
    disagreement = {name: round(_degrees(up, w), 2) for name, w in witnesses.items()}
    return Upright(up, source, floor.point if floor else None, disagreement)


def _verdict(witnesses: dict[str, Array]) -> tuple[Array, str]:
    """Up and its source. Floor and lines err for different reasons, depth and poses: the middle of both is better."""
    floor, lines = witnesses.get("floor"), witnesses.get("upright lines")
    if floor is not None and lines is not None and _degrees(floor, lines) < _AGREE:
        return (floor + lines) / float(np.linalg.norm(floor + lines)), "floor and upright lines"
    source = "upright lines" if lines is not None else "floor" if floor is not None else "level surfaces"
    return witnesses[source], source


def surface_voxels(outcome: Outcome, rows: Sequence[int]) -> Voxels:
    """The surface that the map shows in keyframes of the trajectory, as voxels a sixtieth of its usual depth wide."""
    t, camera, near = outcome.trajectory, outcome.calibration.intrinsics.at_most(_SIDE), maps_around(outcome)

    def view(row: int) -> PosedDepth:
        return depth_view(near(int(t.frame_ids[row])), t.cam_from_world[row], camera)

    views = list(map_lookahead(view, rows, host_threads(outcome.require_map().means)))
    seen = np.concatenate([np.zeros(0), *(v.depth[v.trust > 0] for v in views)])
    size = float(np.median(seen)) / VOXELS_PER_DEPTH if len(seen) else 1.0
    return gather_depths(views, size)


def _degrees(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@dataclass(frozen=True)
class Vertical:
    """up (3,) unit vector in the world; `lines` within a degree of it, and the `contrast` of their length there to the
    length a degree farther out, where only chance brings lines."""

    up: Array
    lines: int
    contrast: float

    @property
    def is_sure(self) -> bool:
        """Far more lines are vertical than chance would have it."""
        return self.lines >= _MIN_LINES and self.contrast >= _MIN_CONTRAST


def line_planes(picture: NDArray[np.uint8], intrinsics: Intrinsics) -> tuple[Array, Array]:
    """normals (L, 3) in the camera of the planes through its straight segments, and lengths (L,) in image sides.

    `picture`: (H, W, 3) RGB without lens distortion. Segments by LSD (von Gioi et al., PAMI 2010).
    """
    side = max(picture.shape[:2])
    grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
    found = cv2.createLineSegmentDetector().detect(grey)[0]
    if found is None:
        return np.zeros((0, 3)), np.zeros(0)
    # OpenCV counts from the centre of the first pixel.
    ends = np.asarray(found, np.float64).reshape(-1, 2, 2) + 0.5
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / side
    ends, lengths = ends[lengths > _MIN_LENGTH], lengths[lengths > _MIN_LENGTH]
    k = intrinsics
    rays = np.concatenate([(ends - (k.cx, k.cy)) / (k.fx, k.fy), np.ones((len(ends), 2, 1))], axis=2)
    normals = np.cross(rays[:, 0], rays[:, 1])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), lengths


def up_of_lines(
    pictures: Iterable[NDArray[np.uint8]], cam_from_world: Array, intrinsics: Intrinsics, prior: Array, threads: int = 1
) -> Vertical:
    """Up by the lines of images at poses cam_from_world (N, 4, 4), near the unit vector `prior` (3,)."""
    found = list(parallel_map(lambda picture: line_planes(picture, intrinsics), pictures, threads))
    turned = (n @ p[:3, :3] for (n, _), p in zip(found, cam_from_world, strict=True))
    lengths = np.concatenate([np.zeros(0), *(w for _, w in found)])
    return common_direction(np.concatenate([np.zeros((0, 3)), *turned]), lengths, prior)


def common_direction(normals: Array, lengths: Array, prior: Array) -> Vertical:
    """The direction near `prior` (3,) that lies in the most planes (L, 3), each counted by its length (L,)."""
    if len(normals) == 0:
        return Vertical(prior, 0, 0.0)
    candidates = _around(prior)
    off = np.degrees(np.arccos(np.clip(candidates @ prior, -1, 1)))
    votes = np.exp(-0.5 * ((candidates @ normals.T) / _sine(_COARSE_SD)) ** 2) @ lengths
    up = candidates[int((votes * np.exp(-0.5 * (off / _PRIOR_SD) ** 2)).argmax())]
    for sd in _SDS:
        up = _refined(up, normals, lengths, _sine(sd))
    away = np.degrees(np.arcsin(np.clip(np.abs(normals @ up), 0, 1)))
    inside, ring = away < _INSIDE, (away > 3 * _INSIDE) & (away < 15 * _INSIDE)
    by_chance = float(lengths[ring].sum()) / 12 + 1e-9
    return Vertical(up, int(inside.sum()), float(lengths[inside].sum()) / by_chance)


def _refined(up: Array, normals: Array, lengths: Array, sd: float) -> Array:
    """One step of robust least squares on the sphere (Geman-McClure); what the lines leave open stays as it was."""
    weights = lengths / (1 + ((normals @ up) / sd) ** 2) ** 2
    tangent = np.linalg.svd(up[None])[2][1:]
    across = normals @ tangent.T
    matrix = (across * weights[:, None]).T @ across + 0.02 * weights.sum() * np.eye(2)
    step = np.linalg.solve(matrix, -(across * weights[:, None]).T @ (normals @ up))
    moved = up + step @ tangent
    return np.asarray(moved / np.linalg.norm(moved))


def _around(direction: Array) -> Array:
    """(D, 3) unit vectors every two degrees within `_REACH` of a direction."""
    steps = np.arange(-_REACH, _REACH + 1e-9, 2.0)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    offsets = offsets[np.hypot(offsets[:, 0], offsets[:, 1]) <= _REACH]
    out = direction + np.tan(np.radians(offsets)) @ np.linalg.svd(direction[None])[2][1:]
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def _sine(degrees: float) -> float:
    return float(np.sin(np.radians(degrees)))
