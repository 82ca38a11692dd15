"""Building a room's surfaces: materials, quadrilaterals, boxes, walls with openings."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .textures import Random

CLASSES = (
    "wall", "floor", "ceiling", "window", "door", "thing", "lamp", "seating", "table", "bed", "storage", "curtain",
    "picture", "screen", "appliance", "plant",
)  # fmt: skip
FIRST_OF_THINGS = CLASSES.index("thing")
Array = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
THICK = 0.14
"""Metres of a wall between two rooms of a home."""


@dataclass(frozen=True)
class Material:
    """Linear colour (3,), number of its texture (-1: none), metres that this spans, light that it gives off (3,), how
    much of what is mirrored in it it shows, and by what share it is lighter and darker from place to place."""

    rgb: NDArray[np.float32]
    texture: int
    size: float
    emission: NDArray[np.float32]
    gloss: float
    wear: float


@dataclass(frozen=True)
class Opening:
    """A window, a door, a doorway with a room behind, or a passage to another room of a home, in a wall: from
    (left, low) to (right, high), metres along and above the wall's foot."""

    left: float
    low: float
    right: float
    high: float
    kind: str


class Surfaces:
    """Triangles with materials, classes and numbers of things, and the rectangles that give light. What is added stands
    in the frame `place` (4, 4). Where walls and floors are `worn`, their textures look the same nowhere: those that
    repeat in whole rooms are recognised where nobody has been."""

    def __init__(self, worn: bool = False) -> None:
        self.worn = worn
        self.place = np.eye(4)
        self.parts: list[tuple[NDArray[np.float32], ...]] = []
        self.materials: list[Material] = []
        self.textures: list[NDArray[np.uint8]] = []
        self.lights: list[tuple[Array, Array, Array, Array]] = []
        self.label, self.thing, self.things = 0, 0, 0

    def material(
        self,
        rgb: NDArray | tuple[float, ...],
        texture: NDArray[np.uint8] | None = None,
        size: float = 1.0,
        emission: NDArray | tuple[float, ...] = (0, 0, 0),
        gloss: float = 0.0,
        wear: float = 0.0,
    ) -> int:
        """Number of a new material."""
        number = -1
        if texture is not None:
            number = len(self.textures)
            self.textures.append(texture)
        light = np.asarray(emission, np.float32)
        self.materials.append(Material(np.asarray(rgb, np.float32), number, size, light, gloss, wear))
        return len(self.materials) - 1

    def of_class(self, name: str) -> None:
        """What is added from here on is of this class; of walls, floors, ceilings, windows and doors it is no thing."""
        self.label = CLASSES.index(name)
        self.thing = 0 if self.label < FIRST_OF_THINGS else self.thing

    def new_thing(self) -> None:
        """What is added from here on is a thing of its own."""
        self.things += 1
        self.thing = self.things

    def add(
        self, triangles: NDArray, places: NDArray, material: int | NDArray[np.int32], normals: NDArray | None = None
    ) -> None:
        """Add triangles (F, 3, 3) with texture places (F, 3, 2); without normals they are flat."""
        triangles = np.asarray(triangles, np.float32)
        if normals is None:
            flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
            flat /= np.maximum(np.linalg.norm(flat, axis=1), 1e-12)[:, None]
            normals = np.repeat(flat[:, None], 3, 1)
        numbers = np.broadcast_to(np.asarray(material, np.int32), len(triangles))
        labels = np.full(len(triangles), self.label + 256 * self.thing, np.int32)
        turn, start = self.place[:3, :3].T, self.place[:3, 3]
        shape = (triangles @ turn + start).astype(np.float32), (normals @ turn).astype(np.float32)
        self.parts.append((*shape, np.asarray(places, np.float32), numbers, labels))

    def quad(
        self, corner: Array, a: Array, b: Array, material: int, places: list | None = None, light: Array | None = None
    ) -> None:
        """The rectangle corner, corner + a, ... ; seen from where a x b points to; `light`: what it gives off."""
        corner, a, b = (np.asarray(x, float) for x in (corner, a, b))
        size = self.materials[material].size
        across, along = np.linalg.norm(a) / size, np.linalg.norm(b) / size
        u = np.array(places or [(0, 0), (across, 0), (across, along), (0, along)], float)
        corners = [[corner, corner + a, corner + a + b], [corner, corner + a + b, corner + b]]
        self.add(np.array(corners), u[[[0, 1, 2], [0, 2, 3]]], material)
        if light is not None:
            turn = self.place[:3, :3]
            lamp = turn @ corner + self.place[:3, 3], turn @ a, turn @ b, np.asarray(light, float)
            self.lights.append(lamp)

    def box(
        self, low: tuple, high: tuple, material: int, frame: Array | None = None, faces: tuple = tuple(range(6))
    ) -> None:
        """A box between two corners in a frame (4, 4)."""
        lo, hi = np.array(low, float), np.array(high, float)
        frame = np.eye(4) if frame is None else frame
        for face in faces:
            axis, far = face // 2, face % 2
            first, second = (axis + 1) % 3, (axis + 2) % 3
            if not far:
                first, second = second, first
            corner, a, b = lo.copy(), np.zeros(3), np.zeros(3)
            corner[axis] = (lo, hi)[far][axis]
            a[first], b[second] = (hi - lo)[first], (hi - lo)[second]
            if first == 1:  # upright faces: the texture runs down
                corner, a, b = corner + a, b, -a
            turn = frame[:3, :3]
            self.quad(turn @ corner + frame[:3, 3], turn @ a, turn @ b, material)


def frame_of(origin: Array, x: Array, z: Array) -> Array:
    """(4, 4) of a frame with y up."""
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = x, UP, z, origin
    return out


def standing(x: float, y: float, z: float, angle: float) -> Array:
    """(4, 4) of a thing that stands there and looks along (sin, 0, cos) of the angle."""
    c, s = math.cos(angle), math.sin(angle)
    return frame_of(np.array([x, y, z]), np.array([c, 0, -s]), np.array([s, 0, c]))


@dataclass(frozen=True)
class Wall:
    """From `origin` along the unit vector `along` for `length`; `inward` is its normal."""

    origin: Array
    along: Array
    length: float
    inward: Array
    openings: list[Opening]

    @property
    def frame(self) -> Array:
        """(4, 4) with x along, y up, z inward."""
        return frame_of(self.origin, self.along, self.inward)


@dataclass(frozen=True)
class Trim:
    """Materials of frames, doors and metal; of what is seen through windows, and its light (3,)."""

    frame: int
    door: int
    metal: int
    sky: int
    sky_light: Array


def build_wall(s: Surfaces, wall: Wall, height: float, material: int, trim: Trim, r: Random) -> None:
    """The wall around its openings, and what closes them."""
    s.of_class("wall")
    size, holes = s.materials[material].size, wall.openings
    across = sorted({0, wall.length, *(x for h in holes for x in (h.left, h.right))})
    upward = sorted({0, height, *(x for h in holes for x in (h.low, h.high))})
    for a, b in itertools.pairwise(across):
        for low, high in itertools.pairwise(upward):
            x, y = (a + b) / 2, (low + high) / 2
            if any(h.left < x < h.right and h.low < y < h.high for h in holes):
                continue
            u0, u1, v0, v1 = a / size, b / size, low / size, high / size
            corner = wall.origin + wall.along * a + UP * low
            places = [(u0, -v0), (u1, -v0), (u1, -v1), (u0, -v1)]
            s.quad(corner, wall.along * (b - a), UP * (high - low), material, places)
    for hole in holes:
        _close(s, wall, hole, material, trim, r)


def _close(s: Surfaces, wall: Wall, hole: Opening, material: int, trim: Trim, r: Random) -> None:
    """Reveal, frame, and window, door leaf or the room behind."""
    window = hole.kind == "window"
    deep = r.uniform(0.06, 0.35) if window else r.uniform(0.02, 0.12) if hole.kind != "passage" else THICK / 2
    corner = wall.origin + wall.along * hole.left + UP * hole.low
    width, height = hole.right - hole.left, hole.high - hole.low
    a, b, back = wall.along * width, UP * height, -wall.inward * deep
    for start, edge in ((corner, a), (corner + b, a), (corner, b), (corner + a, b)):
        s.quad(start, edge, back, material if window else trim.frame)
    frame = frame_of(corner + back, wall.along, wall.inward)
    s.of_class("window" if window else "door")
    if window:
        _glaze(s, frame, corner + back, a, b, trim, r)
    elif hole.kind == "door":
        _hang_door(s, frame, corner + back, a, b, trim, r)
    elif hole.kind == "doorway":
        _room_behind(s, frame, width, height, trim, r)
    if r.random() < 0.8:
        t = r.uniform(0.05, 0.1)
        for low, high in (
            ((-t, 0, deep), (0, height + t, deep + 0.02)),
            ((width, 0, deep), (width + t, height + t, deep + 0.02)),
            ((-t, height, deep), (width + t, height + t, deep + 0.02)),
        ):
            s.box(low, high, trim.frame, frame)


def _glaze(s: Surfaces, frame: Array, corner: Array, a: Array, b: Array, trim: Trim, r: Random) -> None:
    width, height = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    u, v = (corner[::2] * 0.37 % 1) * 0.4  # no two windows show the same
    view = [(u, v + 0.6), (u + 0.6, v + 0.6), (u + 0.6, v), (u, v)]
    s.quad(corner, a, b, trim.sky, view, light=trim.sky_light)
    t, columns, rows = r.uniform(0.03, 0.07), int(r.integers(1, 4)), int(r.integers(1, 3))
    for i in range(columns + 1):
        x = min(max(i * width / columns - t / 2, 0), width - t)
        s.box((x, 0, 0.002), (x + t, height, 0.04), trim.frame, frame)
    for i in range(rows + 1):
        y = min(max(i * height / rows - t / 2, 0), height - t)
        s.box((0, y, 0.002), (width, y + t, 0.04), trim.frame, frame)
    if r.random() < 0.5:
        s.box((-0.03, -0.03, -0.02), (width + 0.03, 0.0, r.uniform(0.1, 0.5)), trim.frame, frame)
    if r.random() < 0.3:  # blinds
        shut, gap = r.uniform(0.2, 0.9), r.uniform(0.03, 0.06)
        for k in range(int(shut * height / gap)):
            y = height - (k + 1) * gap
            s.box((0.01, y, 0.05), (width - 0.01, y + gap * 0.5, 0.06), trim.frame, frame)


def _hang_door(s: Surfaces, frame: Array, corner: Array, a: Array, b: Array, trim: Trim, r: Random) -> None:
    width, height = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    s.quad(corner, a, b, trim.door)
    if r.random() < 0.7:
        for k in range(int(r.integers(1, 4))):
            y = 0.12 + k * 0.6
            s.box((0.12, y, 0), (width - 0.12, min(y + 0.45, height - 0.1), 0.012), trim.door, frame)
    s.box((0.06, 1.0, 0), (0.18, 1.03, 0.05), trim.metal, frame)


def _room_behind(s: Surfaces, frame: Array, width: float, height: float, trim: Trim, r: Random) -> None:
    """An open door: a bare room of its own light behind, with a box or two, and the leaf turned into it."""
    side, deep, top = r.uniform(0.4, 1.5), r.uniform(1.5, 4), max(2.4, height + 0.2)
    low, high = np.array([-side, 0, -deep]), np.array([width + side, top, -0.01])
    for axis, far, a, b in ((0, 0, 2, 1), (0, 1, 2, 1), (1, 0, 0, 2), (1, 1, 0, 2), (2, 0, 0, 1)):
        corner, first, second = low.copy(), np.zeros(3), np.zeros(3)
        corner[axis] = (low, high)[far][axis]
        first[a], second[b] = (high - low)[a], (high - low)[b]
        material = (trim.frame, trim.door)[axis == 1 and not far]
        s.of_class("wall" if axis != 1 else "ceiling" if far else "floor")
        s.quad(frame[:3, :3] @ corner + frame[:3, 3], frame[:3, :3] @ first, frame[:3, :3] @ second, material)
    glow = np.full(3, r.uniform(1, 8))
    middle = frame[:3, :3] @ np.array([width / 2 - 0.3, top - 0.03, -deep / 2]) + frame[:3, 3]
    s.quad(middle, frame[:3, 0] * 0.6, frame[:3, 2] * 0.6, s.material((0.5,) * 3, emission=glow), light=glow)
    s.of_class("storage")
    for _ in range(int(r.integers(0, 3))):
        x, w, h = r.uniform(-side, width), r.uniform(0.2, 0.8), r.uniform(0.3, 1.8)
        s.box((x, 0, -deep), (x + w, h, -deep + r.uniform(0.2, 0.6)), trim.door, frame)
    s.of_class("door")
    s.box((-0.01, 0, -width), (0.03, height, -0.02), trim.door, frame)
