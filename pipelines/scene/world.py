"""The world of the exported files, and the transform from the run's own to it."""

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import Similarity
from ..outcome import Outcome
from ..run.schema import RunFile, dataclass_from_json
from .upright import Upright, cameras_up

Array = NDArray[np.float64]

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
        "up_told_by": world.source,
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
        source=str(value["up_told_by"]),
        has_floor=bool(value["floor_at_zero"]),
        exported_from_run=Similarity(float(move["scale"]), rotation, translation),
        disagreement_deg={str(name): float(v) for name, v in value["degrees_from_up"].items()},
        earth=None
        if earth is None
        else dataclass_from_json(Georeference, {k: earth[k] for k in earth if k != "frame"}),
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
