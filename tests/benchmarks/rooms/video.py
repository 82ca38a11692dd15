"""A hand-held walk of twelve seconds through a made room."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .film import Camera, Tremor, film, looking, waves
from .furniture import Catalogue
from .light import LitRoom
from .room import Room, build_room
from .textures import Random

WIDTH, HEIGHT, SECONDS, RATE = 640, 480, 12, 10
_CELL, _BODY, _CLEAR = 0.05, 0.25, 0.3
"""Metres: cells of the floor, room that a person takes around its middle, what the camera stays away from things."""
_TRIES, _COMPARED = 4000, 12
_FAR = 1.5
"""Metres of a walk: on a shorter one the camera hardly does more than turn."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Walk:
    """Along a curve (3, 3) of the floor plan with its height, turning once around by `sweep`."""

    curve: Array
    yaw: float
    sweep: float
    pitch: float
    nod: float
    shake: Tremor
    seconds: float = SECONDS

    @property
    def length(self) -> float:
        """Metres of the curve, without tremor and sway."""
        u = np.linspace(0, 1, 33)[:, None]
        a, b, c = self.curve
        return float(np.linalg.norm(np.diff((1 - u) ** 2 * a + 2 * u * (1 - u) * b + u**2 * c, axis=0), axis=1).sum())

    def poses(self, times: Array) -> Array:
        """world_from_cam (..., 4, 4) at `times` (...) in seconds; x right, y down, z forward."""
        u = times / SECONDS
        along = (u + 0.03 - 0.03 * np.cos(2 * np.pi * u) - 0.1 * np.sin(2 * np.pi * u) / (2 * np.pi))[..., None]
        a, b, c = self.curve
        eye = (1 - along) ** 2 * a + 2 * along * (1 - along) * b + along**2 * c
        yaw = self.yaw + self.sweep * (u + 0.06 * np.sin(4 * np.pi * u + self.shake.phases[0]))
        pitch = self.pitch + self.nod * np.sin(3 * np.pi * u + self.shake.phases[1])
        return looking(eye, yaw, pitch, self.shake(times))


def make_video(seed: int, catalogue: Catalogue, target: Path) -> bool:
    """Write video.mp4 and the truth beside it; False where there is no place to walk."""
    room, r = build_room(seed, catalogue)
    lit = LitRoom(room.surfaces)
    walk = _walk(room, lit, r)
    if walk is not None:
        film(lit, walk, Camera(WIDTH, HEIGHT, float(r.uniform(0.7, 0.98)) * WIDTH, RATE), target, r)
    return walk is not None


# the walk -------------------------------------------------------------------------------------------------------


def _walk(room: Room, lit: LitRoom, r: Random) -> Walk | None:
    """A curve of 1.2 to 5 metres over free floor; of some such walks that which sees farthest and is no mere
    turn: people film across a room."""
    free, ball = _free_floor(room), r.normal(size=(150, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    places = (np.argwhere(free) + 0.5) * _CELL
    height = r.uniform(1.2, min(1.65, room.size[2] - 0.5))
    found: list[tuple[float, Walk]] = []
    for _ in range(_TRIES if len(places) else 0):
        x, z = places[r.integers(len(places), size=3)].T
        walk = _some_walk(np.stack([x, height + r.normal(size=3) * 0.08, z], 1), r)
        path = walk.poses(np.linspace(0, SECONDS, 49))
        cells = (path[:, [0, 2], 3] / _CELL).astype(int)
        length = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).sum()
        if not 1.2 <= length <= 5 or not free[tuple(np.clip(cells, 0, np.array(free.shape) - 1).T)].all():
            continue
        if (seen := _sees(lit, path[::4], ball)) > 0:
            found.append((seen * min(1.0, walk.length / _FAR), walk))
        if len(found) == _COMPARED:
            break
    return max(found, key=lambda f: f[0])[1] if found else None


def _free_floor(room: Room) -> NDArray[np.bool_]:
    """Cells (x, z) of the floor on which a person can stand."""
    wide, deep, _ = room.size
    x, z = np.meshgrid(np.arange(0, wide, _CELL), np.arange(0, deep, _CELL), indexing="ij")
    free = (x > 0.35) & (z > 0.35) & (x < wide - 0.35) & (z < deep - 0.35)
    for a, b, c, d in room.taken + room.entries:
        free &= (x < a - _BODY) | (x > c + _BODY) | (z < b - _BODY) | (z > d + _BODY)
    return free


def _some_walk(curve: Array, r: Random) -> Walk:
    frequencies, amplitudes = waves(r)
    sweep = math.radians(r.uniform(80, 230)) * r.choice([-1, 1])
    pitch, nod = r.normal() * 0.08 - 0.2, r.uniform(0.05, 0.2)
    yaw = r.uniform(0, 2 * np.pi)
    return Walk(curve, yaw, sweep, pitch, nod, Tremor(frequencies, r.uniform(0, 6.28, 12), amplitudes))


def _sees(lit: LitRoom, poses: Array, ball: Array) -> float:
    """Metres that the views see, on average, at most four of each; 0 where one of them is close to something."""
    middles = []
    for pose in poses:
        far = lit.distance(pose[:3, 3], ball)
        ahead = far[(ball @ pose[:3, 2]) > 0.85]
        if far.min() < _CLEAR or len(ahead) == 0 or ahead.min() < 0.4 or not 0.9 < np.median(ahead) < 20:
            return 0.0
        middles.append(min(float(np.median(ahead)), 4.0))
    return float(np.mean(middles))
