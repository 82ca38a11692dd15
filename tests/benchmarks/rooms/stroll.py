"""A walk through a home as people film it: from room to room, a look around in each, fast turns, a bare wall."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, minimum_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from .film import Camera, Tremor, film, looking, waves
from .furniture import Catalogue
from .home import Home, build_home
from .light import LitRoom
from .surfaces import CLASSES, THICK, UP, Array
from .textures import Random

RATE, SIDES = 12, (480, 640)
LEAST, MOST = 30, 90
"""Seconds."""
_CELL, _BODY, _CLEAR = 0.06, 0.24, 0.3
_STEP = 0.02
_FASTEST, _EAGER = math.radians(120), 4.5
"""Radians a second that the camera turns at most; how soon it follows, per second."""
_TRIES = 12
_NEAR, _BARE = 1.6, 0.97
"""A wall within so many metres that fills so much of the image."""


@dataclass(frozen=True)
class Stroll:
    """eye (N, 3), yaw and pitch (N,) every _STEP seconds, and the tremor on them; the rooms visited."""

    eye: Array
    yaw: Array
    pitch: Array
    shake: Tremor
    rooms: list[int]
    returns: bool

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return _STEP * (len(self.eye) - 1)

    def poses(self, times: Array) -> Array:
        """world_from_cam (..., 4, 4) at `times` (...) in seconds."""
        at = np.arange(len(self.eye)) * _STEP
        x, y, z, yaw, pitch = (np.interp(times, at, c) for c in (*self.eye.T, self.yaw, self.pitch))
        return looking(np.stack([x, y, z], -1), yaw, pitch, self.shake(times))


def make_stroll(seed: int, catalogue: Catalogue, target: Path) -> bool:
    """Write the video of a walk, upright or across, and the truth beside it; False where there is no way to walk."""
    home, r = build_home(seed, catalogue)
    lit = LitRoom(home.surfaces)
    walk = stroll_through(home, lit, r)
    if walk is not None:
        width, height = (SIDES, SIDES[::-1])[r.integers(2)]
        focal = r.uniform(0.68, 0.8) * max(SIDES)
        film(lit, walk, Camera(width, height, focal, RATE, held=0.15, follows=0.3, rays=2), target, r)
    return walk is not None


def stroll_through(home: Home, lit: LitRoom, r: Random) -> Stroll | None:
    """A walk of 30 to 90 seconds, in half of the homes back to where it began; None where there is no way."""
    floor = _Floor(home)
    for _ in range(_TRIES):
        order = _order(home, r)
        returns = r.random() < 0.5
        stops = [s for s in (floor.spot(n, r) for n in order) if s is not None]
        if len(stops) < 3:
            continue
        legs = [floor.way(a, b) for a, b in zip(stops, stops[1:] + stops[:1] * returns, strict=False)]
        if any(len(leg) < 4 for leg in legs):
            continue
        found = _filmed_along(legs, order, returns, lit, r)
        if found is not None and LEAST <= found.seconds <= MOST:
            return found
    return None


def _order(home: Home, r: Random) -> list[int]:
    """Rooms as one comes to them from one of the outermost: those behind each door in turn."""
    near: dict[int, list[int]] = {n: [] for n in range(len(home.places))}
    for n, place in enumerate(home.places):
        if place.parent >= 0:
            near[n].append(place.parent)
            near[place.parent].append(n)
    leaves = [n for n in near if len(near[n]) == 1]
    order: list[int] = []

    def visit(n: int, before: int) -> None:
        order.append(n)
        for k in r.permutation([k for k in near[n] if k != before]):
            visit(int(k), n)

    visit(int(r.choice(leaves)), -1)
    rooms = [n for n in order if home.places[n].kind == "home"]
    return rooms[: int(r.integers(3, len(rooms) + 1))]


class _Floor:
    """Cells of all floors on which a person can stand, and the ways between them."""

    def __init__(self, home: Home) -> None:
        self.home = home
        bounds = np.stack([p.bounds() for p in home.places])
        self.low = bounds[:, 0, ::2].min(0) - 1
        shape = np.ceil((bounds[:, 1, ::2].max(0) + 1 - self.low) / _CELL).astype(int)
        self.free, self.room = np.zeros(shape, bool), np.full(shape, -1)
        self.height = np.zeros(shape)
        middles = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * _CELL + self.low
        for n in range(len(home.places)):
            self._add_room(n, middles)
        self.clear = distance_transform_edt(self.free) * _CELL
        self.graph, self.number = self._ways()

    def _add_room(self, n: int, middles: Array) -> None:
        place, room = self.home.places[n], self.home.rooms[n]
        wide, deep, _ = place.size
        x, z = np.moveaxis((middles - place.frame[[0, 2], 3]) @ place.frame[np.ix_([0, 2], [0, 2])], -1, 0)
        free = (x > _BODY) & (z > _BODY) & (x < wide - _BODY) & (z < deep - _BODY)
        for a, b, c, d in room.taken:
            free &= (x < a - _BODY) | (x > c + _BODY) | (z < b - _BODY) | (z > d + _BODY)
        inside = (x >= 0) & (z >= 0) & (x <= wide) & (z <= deep)
        for wall, holes in zip(room.walls, place.doors, strict=True):
            u = (x - wall.origin[0]) * wall.along[0] + (z - wall.origin[2]) * wall.along[2]
            v = (x - wall.origin[0]) * wall.inward[0] + (z - wall.origin[2]) * wall.inward[2]
            for h in holes:
                through = (u > h.left + _BODY) & (u < h.right - _BODY) & (v > -THICK) & (v < 0.3)
                free |= through
                inside |= through & (v > -THICK / 2)
        self.free |= free
        self.room[inside] = n
        self.height[inside] = place.level(x, z)[inside]

    def _ways(self) -> tuple[coo_array, NDArray[np.int64]]:
        number = np.full(self.free.shape, -1)
        number[self.free] = np.arange(self.free.sum())
        cost = 1 / np.minimum(self.clear + 0.05, 0.5)
        rows, columns, costs = [], [], []
        for dx, dz in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = number[: number.shape[0] - dx, max(0, -dz) : number.shape[1] - max(0, dz)]
            b = number[dx:, max(0, dz) : number.shape[1] + min(0, dz)]
            c = cost[: number.shape[0] - dx, max(0, -dz) : number.shape[1] - max(0, dz)]
            both = (a >= 0) & (b >= 0)
            rows.append(a[both])
            columns.append(b[both])
            costs.append(c[both] * math.hypot(dx, dz))
        at = np.concatenate(rows), np.concatenate(columns)
        return coo_array((np.concatenate(costs), at), shape=(number.max() + 1,) * 2).tocsr(), number

    def spot(self, n: int, r: Random) -> tuple[int, int] | None:
        """A cell of a room, well inside it and clear of things."""
        cells = np.argwhere(self.free & (self.room == n))
        if len(cells) == 0:
            return None
        place = self.home.places[n]
        far = (
            np.linalg.norm(cells * _CELL + self.low - place.door[::2], axis=1)
            if place.parent >= 0
            else np.ones(len(cells))
        )
        worth = np.minimum(self.clear[tuple(cells.T)], 0.5) + 0.3 * np.minimum(far, 2.0) + r.uniform(0, 0.4, len(cells))
        return tuple(int(c) for c in cells[worth.argmax()])  # type: ignore[return-value]

    def way(self, start: tuple[int, int], end: tuple[int, int]) -> Array:
        """(K, 3) places on the floor a centimetre apart, smooth; without any where there is no way."""
        a, b = self.number[start], self.number[end]
        cost, before = dijkstra(self.graph, directed=False, indices=a, return_predecessors=True)
        if not np.isfinite(cost[b]):
            return np.zeros((0, 3))
        chain = [b]
        while chain[-1] != a:
            chain.append(before[chain[-1]])
        cells = np.argwhere(self.free)[chain[::-1]]
        path = np.column_stack([cells * _CELL + self.low, self.height[tuple(cells.T)]])[:, [0, 2, 1]]
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path[:, ::2], axis=0), axis=1))])
        even = np.arange(0, along[-1], 0.01)
        dense = np.stack([np.interp(even, along, c) for c in path.T], 1)
        return np.stack(
            [gaussian_filter1d(c, s, mode="nearest") for c, s in zip(dense.T, (14, 12, 14), strict=True)], 1
        )


def _filmed_along(legs: list[Array], order: list[int], returns: bool, lit: LitRoom, r: Random) -> Stroll | None:
    """Walk the legs; at the end of each stop and look around, or at a bare wall where there is one."""
    tall, pace = r.uniform(1.35, 1.6), r.uniform(0.7, 1.1)
    eyes: list[Array] = []
    wanted: list[Array] = []
    first = _heading(legs[0])[0]
    _look_around(eyes, wanted, legs[0][0], first, lit, tall, r)
    for leg in legs:
        length = 0.01 * len(leg)
        times = np.arange(0, length / pace + 0.8, _STEP)
        gone = _eased(times / times[-1]) * (len(leg) - 1)
        eyes.append(np.stack([np.interp(gone, np.arange(len(leg)), c) for c in leg.T], 1))
        ahead = np.interp(np.minimum(gone + 45, len(leg) - 1), np.arange(len(leg)), _heading(leg))
        wanted.append(ahead + 0.3 * np.sin(times * r.uniform(0.6, 1.3) + r.uniform(0, 6.28)))
        _look_around(eyes, wanted, leg[-1], float(ahead[-1]), lit, tall, r)
    if returns:  # the first view again
        count = int(2.0 / _STEP)
        eyes.append(np.broadcast_to(eyes[-1][-1], (count, 3)))
        wanted.append(np.full(count, wanted[0][0]))
    yaw = _followed(np.concatenate(wanted))
    eye = _held_out(np.concatenate(eyes) + tall * UP, yaw, r.uniform(0.25, 0.45), lit)
    times = np.arange(len(eye)) * _STEP
    pitch = -r.uniform(0.05, 0.25) + 0.08 * np.sin(times * r.uniform(0.5, 1) + r.uniform(0, 6.28))
    frequencies, amplitudes = waves(r)
    return Stroll(eye, yaw, pitch, Tremor(frequencies, r.uniform(0, 6.28, 12), amplitudes), order, returns)


def _heading(leg: Array) -> Array:
    way = np.gradient(leg[:, ::2], axis=0)
    return np.unwrap(np.arctan2(way[:, 1], way[:, 0]))


def _eased(u: Array) -> Array:
    """0 to 1, slow at both ends."""
    return np.asarray(0.55 * u + 0.45 * (3 * u**2 - 2 * u**3))


def _look_around(
    eyes: list[Array], wanted: list[Array], at: Array, yaw: float, lit: LitRoom, tall: float, r: Random
) -> None:
    """Some seconds on the spot: a bare wall, or a sweep to one side and back."""
    bare = _bare_wall(at + tall * UP, yaw, lit) if r.random() < 0.4 else None
    if bare is not None:
        turns = [(bare, r.uniform(1.5, 3))]
    else:
        side, span = r.choice([-1, 1]), math.radians(r.uniform(60, 150))
        turns = [(yaw + side * span, r.uniform(1.5, 2.5)), (yaw - side * span * r.uniform(0, 0.6), r.uniform(1, 2))]
    for turn, seconds in turns:
        count = int(seconds / _STEP)
        eyes.append(np.broadcast_to(at, (count, 3)))
        wanted.append(np.linspace(yaw, turn, count) if bare is None else np.full(count, turn))
        yaw = turn


def _bare_wall(eye: Array, yaw: float, lit: LitRoom) -> float | None:
    """The direction, not far from `yaw`, in which a near wall is all that is seen."""
    for turn in np.radians([-40, 40, -80, 80, -120, 120]):
        pose = looking(eye, np.array(yaw + turn), np.array(-0.1), np.zeros(6))
        depth, label = lit.measure(pose, 18, 24, 18.0)
        if np.median(depth) < _NEAR and (label == CLASSES.index("wall")).mean() > _BARE:
            return float(yaw + turn)
    return None


def _held_out(body: Array, yaw: Array, reach: float, lit: LitRoom) -> Array:
    """(N, 3) where the camera is: before the body, by as much as arms reach and things leave room."""
    ahead = np.stack([np.cos(yaw), 0 * yaw, np.sin(yaw)], 1)
    hit = lit.cast(body, ahead)
    room = np.where(hit["primID"] >= 0, hit["tfar"], 1e3) - _CLEAR
    span = 2 * int(0.5 / _STEP) + 1
    held = gaussian_filter1d(minimum_filter1d(np.clip(room, 0, reach), span), span / 4)
    return np.asarray(body + held[:, None] * ahead)


def _followed(wanted: Array) -> Array:
    """What a camera does that is turned towards where one wants to look: soon, but no faster than people turn."""
    target = np.unwrap(wanted)
    out, speed, yaw = np.empty_like(target), 0.0, float(target[0])
    for k, goal in enumerate(target):
        away = (goal - yaw + np.pi) % (2 * np.pi) - np.pi
        speed += _STEP * (_EAGER**2 * away - 2 * _EAGER * speed)
        speed = float(np.clip(speed, -_FASTEST, _FASTEST))
        yaw += _STEP * speed
        out[k] = yaw
    return out
