"""Up and the floor of a finished run: by vertical lines in its images and level surfaces in its map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..compute.threads import get_threads, host_threads
from ..geometry.posed_depth import PosedDepth
from ..geometry.room_layout import Gravity, find_gravity, floor_plane, name_structure
from ..geometry.voxels import VOXELS_PER_DEPTH, Voxels, gather_depths
from ..mapping.measure import depth_view
from ..outcome import Outcome, evenly, maps_around
from ..system.parallel import abreast
from .lines import up_of_lines

Array = NDArray[np.float64]

_PICTURES, _VIEWS = 40, 24
_SIDE = 200
_AGREE = 3.0
"""Degrees: a floor that leans more against sure upright lines is a ramp, or badly seen; the lines are believed."""


@dataclass(frozen=True)
class Upright:
    """`up` (3,) unit vector in the run's world and its source, "" where none; `floor` (3,) a point of the
    floor, None without one; `against`: degrees between up and what each witness says alone."""

    up: Array
    told_by: str
    floor: Array | None
    against: dict[str, float] = field(default_factory=dict)


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
    rows = evenly(np.flatnonzero(trajectory.is_keyframe).tolist(), _PICTURES)
    poses = trajectory.cam_from_world[rows]
    pictures = (outcome.run.image(outcome.frames[row]) for row in rows)
    lines = up_of_lines(pictures, poses, outcome.calibration.intrinsics, prior, get_threads())
    voxels = surface_voxels(outcome, evenly(rows, _VIEWS))
    level = find_gravity(voxels, prior) if len(voxels) else Gravity(prior, False)
    if not (lines.is_sure or level.is_sure):
        return Upright(prior, "", None)
    first = lines.up if lines.is_sure else level.up
    kinds = name_structure(voxels, Gravity(first, True), trajectory.centers[trajectory.is_posed])
    floor = floor_plane(voxels, kinds, first)
    witnesses = {"cameras": prior, "level surfaces": level.up}
    witnesses |= {"upright lines": lines.up} if lines.is_sure else {}
    witnesses |= {"floor": floor.normal} if floor else {}
    up, told_by = _verdict(witnesses)
    against = {name: round(_degrees(up, w), 2) for name, w in witnesses.items()}
    return Upright(up, told_by, floor.point if floor else None, against)


def _verdict(witnesses: dict[str, Array]) -> tuple[Array, str]:
    """Up and its source. Floor and lines err for different reasons, depth and poses: the middle of both is better."""
    floor, lines = witnesses.get("floor"), witnesses.get("upright lines")
    if floor is not None and lines is not None and _degrees(floor, lines) < _AGREE:
        return (floor + lines) / float(np.linalg.norm(floor + lines)), "floor and upright lines"
    told_by = "upright lines" if lines is not None else "floor" if floor is not None else "level surfaces"
    return witnesses[told_by], told_by


def surface_voxels(outcome: Outcome, rows: Sequence[int]) -> Voxels:
    """The surface that the map shows in keyframes of the trajectory, as voxels a sixtieth of its usual depth wide."""
    t, camera, near = outcome.trajectory, outcome.calibration.intrinsics.at_most(_SIDE), maps_around(outcome)

    def view(row: int) -> PosedDepth:
        return depth_view(near(int(t.frame_ids[row])), t.cam_from_world[row], camera)

    views = list(abreast(view, rows, host_threads(outcome.require_map().means)))
    seen = np.concatenate([np.zeros(0), *(v.depth[v.trust > 0] for v in views)])
    size = float(np.median(seen)) / VOXELS_PER_DEPTH if len(seen) else 1.0
    return gather_depths(views, size)


def _degrees(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
