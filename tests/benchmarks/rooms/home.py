"""A home by seed: three to six rooms joined by open doors, mostly along a corridor, some by a stair."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from .furniture import Catalogue
from .room import Room, fill_room, make_trim, surface, thing_material
from .surfaces import THICK, Array, Opening, Surfaces, frame_of
from .textures import Random, picture

_LANDING, _RUN, _RISE = 1.0, 0.26, 0.18
_TRIES = 300
_LEAST = 3
"""Rooms beside corridor and stair."""


@dataclass
class Place:
    """Where a room stands: world_from_room (4, 4), the room that it was joined to (-1: none) and the middle of the door
    between them in the world (3,)."""

    kind: str
    size: tuple[float, float, float]
    frame: Array
    parent: int
    door: Array
    doors: tuple[list[Opening], ...] = field(default_factory=lambda: ([], [], [], []))

    def bounds(self, margin: float = 0.0) -> Array:
        """(2, 3) least and greatest of its corners."""
        wide, deep, high = self.size
        ends = np.array([[-margin, 0, -margin, 1], [wide + margin, high, deep + margin, 1]]) @ self.frame.T
        return np.stack([ends.min(0), ends.max(0)])[:, :3]

    def level(self, x: Array, z: Array) -> Array:
        """Height of the floor at places of the room."""
        steps = (np.floor((z - _LANDING) / _RUN) + 1) * _RISE if self.kind == "stairs" else np.zeros_like(z)
        return np.asarray(np.clip(steps, 0, _stairs_height(self.size[1])) + self.frame[1, 3])


@dataclass
class Home:
    """Rooms with their places, in one world."""

    places: list[Place]
    rooms: list[Room]
    surfaces: Surfaces


def build_home(seed: int, catalogue: Catalogue) -> tuple[Home, Random]:
    """The home of a seed, and the source of chance for what follows."""
    r = np.random.default_rng(seed)
    places = plan(r)
    home = Home(places, [], Surfaces(worn=True))
    trim, paint = None, None
    for number, place in enumerate(places):
        s = home.surfaces
        s.place = place.frame
        room = Room(place.kind, place.size, s, catalogue, place.doors)
        trim = trim or make_trim(room, r)
        paint = surface(s, r, "wall") if paint is None else paint
        room.trim, room.paint = replace(trim, sky=_outside(room, trim.sky, seed)), paint if r.random() < 0.6 else None
        room.is_outside = lambda wall, hole, n=number: _is_outside(places, n, wall, hole)
        if place.kind == "stairs":
            _build_steps(room, r)
        _open_leaves(room, trim.door, r)
        fill_room(room, r)
        home.rooms.append(room)
    return home, r


def _outside(room: Room, sky: int, seed: int) -> int:
    """What is outside of a room's windows: no other room shows the same picture."""
    s, (x, _, z) = room.surfaces, np.abs(room.surfaces.place[:3, 3] * 1000).astype(np.int64).tolist()
    if s.materials[sky].texture < 0:
        return sky
    r = np.random.default_rng([seed, x, z])
    return s.material((1, 1, 1), picture(r, room.catalogue.textures), emission=s.materials[sky].emission)


# the plan -------------------------------------------------------------------------------------------------------


def plan(r: Random) -> list[Place]:
    """Rooms attached to each other one by one."""
    high = r.uniform(2.35, 2.8)
    narrow = r.uniform(1.15, 1.8), r.uniform(3.5, 7), high
    has_corridor, has_stair, count = r.random() < 0.8, r.random() < 0.3, int(r.integers(_LEAST, 7))
    root = ("corridor", narrow) if has_corridor else ("home", _size(r, high))
    places = [Place(*root, np.eye(4), -1, np.zeros(3))]
    while sum(p.kind == "home" for p in places) < count:
        own = [i for i, p in enumerate(places) if p.kind == "home"]
        stairs = [i for i, p in enumerate(places) if p.kind == "stairs"]
        if has_stair and len(own) == count - 1 and not stairs:
            deep = 2 * _LANDING + _RUN * math.ceil((high + 0.25) / _RISE)
            what, among = ("stairs", (r.uniform(1.0, 1.3), deep, _stairs_height(deep) + high)), [0]
        else:
            what = ("home", _size(r, high))
            among = stairs if has_stair and stairs else [0] if has_corridor and r.random() < 0.75 else own or [0]
        if not _attach(places, *what, among, r):
            break
    return places


def _size(r: Random, high: float) -> tuple[float, float, float]:
    return r.uniform(2.6, 4.8), r.uniform(2.8, 5.2), high


def _stairs_height(deep: float) -> float:
    return round((deep - 2 * _LANDING) / _RUN) * _RISE


def _attach(places: list[Place], kind: str, size: tuple[float, float, float], among: list[int], r: Random) -> bool:
    """Join a room by its first wall to a wall of one of the others, where there is place; whether there was."""
    for _ in range(_TRIES):
        number = int(r.choice(among))
        parent = places[number]
        up = _stairs_height(parent.size[1]) if parent.kind == "stairs" else 0.0
        wall = 2 if parent.kind == "stairs" else int(r.integers(1 if number else 0, 4))
        wide, own, length = r.uniform(0.78, 0.95), size[0], parent.size[0 if wall % 2 == 0 else 1]
        if min(own, length) < wide + 0.12:
            continue
        left, other = r.uniform(0.05, length - wide - 0.05), r.uniform(0.05, own - wide - 0.05)
        high = min(2.05, size[2] - 0.1, parent.size[2] - up - 0.1)
        hole, entry = (
            Opening(left, up, left + wide, up + high, "passage"),
            Opening(other, 0, other + wide, high, "passage"),
        )
        if any(hole.left < d.right + 0.3 and hole.right > d.left - 0.3 for d in parent.doors[wall]):
            continue
        outer = parent.frame @ _wall_frame(parent.size, wall)
        start = outer @ np.array([left + entry.right, up, -THICK, 1])
        frame = frame_of(start[:3], -outer[:3, 0], -outer[:3, 2])
        door = outer @ np.array([left + wide / 2, up, -THICK / 2, 1])
        new = Place(kind, size, frame, number, door[:3])
        if any(_overlap(new.bounds(), p.bounds(THICK / 2)) for p in places):
            continue
        parent.doors[wall].append(hole)
        new.doors[0].append(entry)
        places.append(new)
        return True
    return False


def _wall_frame(size: tuple[float, float, float], wall: int) -> Array:
    """(4, 4) of a wall in its room: x along, z inward."""
    wide, deep, _ = size
    corner = np.array(((0, 0, 0), (wide, 0, 0), (wide, 0, deep), (0, 0, deep))[wall], float)
    ways = np.array(((1, 0, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -1)), float)
    return frame_of(corner, ways[wall], ways[(wall + 1) % 4])


def _overlap(a: Array, b: Array) -> bool:
    """Whether two boxes (2, 3) share floor, on whatever storey: none is above another."""
    return bool((a[0, ::2] < b[1, ::2]).all() and (b[0, ::2] < a[1, ::2]).all())


def _is_outside(places: list[Place], number: int, wall: int, hole: Opening) -> bool:
    """Whether nothing of the home is behind a window; a doorway would need a room of its own."""
    place = places[number]
    if hole.kind != "window" or place.kind == "stairs":
        return False
    outer = place.frame @ _wall_frame(place.size, wall)
    ends = np.array([[hole.left, 0, -0.6, 1], [hole.right, 0, -0.02, 1]]) @ outer.T
    behind = np.stack([ends.min(0), ends.max(0)])[:, :3]
    return not any(_overlap(behind, p.bounds()) for k, p in enumerate(places) if k != number)


# what a home has beside rooms -------------------------------------------------------------------------------------


def _build_steps(room: Room, r: Random) -> None:
    wide, deep, _ = room.size
    count, material = round((deep - 2 * _LANDING) / _RUN), thing_material(room.surfaces, r, 0.7)
    room.surfaces.of_class("floor")
    for k in range(count):
        z, end = _LANDING + k * _RUN, deep if k == count - 1 else _LANDING + (k + 1) * _RUN
        room.surfaces.box((0, k * _RISE, z), (wide, (k + 1) * _RISE, end), material)
    room.entries.append((0, 0, wide, deep))


def _open_leaves(room: Room, material: int, r: Random) -> None:
    """Leaves of some doors, turned into the room by a right angle."""
    room.surfaces.of_class("door")
    for wall, holes in enumerate(room.doors):
        frame = _wall_frame(room.size, wall)
        for hole in holes:
            if r.random() < 0.5 or room.kind != "home":
                continue
            width = hole.right - hole.left
            room.surfaces.box((hole.left - 0.04, hole.low, 0.02), (hole.left, hole.high, width), material, frame)
            ends = frame @ np.array([[hole.left - 0.05, 0, 0, 1], [hole.left, 0, width, 1]]).T
            x, z = ends[0], ends[2]
            room.taken.append((x.min(), z.min(), x.max(), z.max()))
