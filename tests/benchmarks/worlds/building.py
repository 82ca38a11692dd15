"""A building as long as one likes to walk: rooms and corridors in a row, made module by module as they are reached.

Every third module is a corridor, the others are rooms with furniture along both sides. Doors stand left and right in
turn, so that nobody sees further than two modules ahead or back: a picture needs five modules at a time, whatever the
length of the walk. Light and pictures of a module depend on its number alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tests.world.build import Atlas, Scene, World, build_world
from tests.world.cast import SolidArrays
from tests.world.clip import ClipOptions, WorldFrame, develop, render_view
from tests.world.light import Light
from tests.world.paths import EYE_HEIGHT, look_at
from tests.world.shapes import BACK, FRONT, TOP, Material, Solid, box, cylinder, sphere

LENGTH, HEIGHT, WALL = 5.5, 2.6, 0.06
"""Of a module along the walk, of all of them, and of a module's own half of the wall to the next one, metres."""
ROOM_WIDTH, CORRIDOR_WIDTH = 5.0, 3.0
DOOR, DOOR_WIDTH, DOOR_HEIGHT = 0.9, 1.0, 2.1
"""How far to the left or right of the middle a door is, and its size."""
SEEN = 2
SPEED = 0.5
"""Metres a second along the row."""
NAMES = ("none", "wall", "floor", "ceiling", "table", "chair", "shelf", "book", "box", "plant", "picture", "lamp")
_COLORS = tuple((37 * i % 256, 91 * i % 256, 151 * i % 256) for i in range(len(NAMES)))
_WALLS = (("wallpaper", (0.45, 0.52, 0.42)), ("plaster", (0.72, 0.52, 0.36)), ("bricks", (0.5, 0.22, 0.15)))
_FLOORS = (("planks", (0.42, 0.25, 0.12)), ("tiles", (0.42, 0.36, 0.3)), ("wood", (0.6, 0.42, 0.22)))


@dataclass(frozen=True)
class Walk:
    """`seconds` through the building; forth and back `turns` times (walking backwards), once forth for 0."""

    seconds: float
    turns: int = 0

    def poses(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 4, 4) world_from_cam at `times` (N,) in seconds.

        The camera looks ahead through doors, and within a module to the right and then to the left, at the far side.
        Each pass goes a hand's breadth beside the one before.
        """
        span = self.seconds / max(2 * self.turns, 1)
        passed = np.floor(times / span) if self.turns else np.zeros_like(times)
        inside = times - passed * span
        along = SPEED * np.where(passed % 2 == 0, inside, span - inside) + 0.3
        phase = along / LENGTH
        beside = 0.06 * np.sin(1.7 * passed)
        height = EYE_HEIGHT + 0.1 * np.sin(2.3 * along) + 0.02 * np.sin(times)
        center = np.stack([along, DOOR * np.cos(np.pi * phase) + beside, height], 1)
        # Which side is the far one changes from module to module, as the doors do.
        side = np.where(np.floor(phase) % 2 == 0, 1.0, -1.0)
        yaw = -np.radians(48) * side * np.sin(2 * np.pi * phase)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), -0.12 + 0.08 * np.sin(1.1 * along)], 1)
        return look_at(center, center + ahead, 0.02 * np.sin(1.3 * along))


def module_at(x: float) -> int:
    """The number of the module at a place along the row."""
    return int(np.floor(x / LENGTH))


def is_corridor(number: int) -> bool:
    """Every third module is one."""
    return number % 3 == 2


@lru_cache(maxsize=2 * SEEN + 2)
def module(number: int, texel: float) -> World:
    """One module with its own light, at its place."""
    rng = np.random.default_rng([7, abs(number), int(number < 0)])
    width = CORRIDOR_WIDTH if is_corridor(number) else ROOM_WIDTH
    start = number * LENGTH
    solids = _shell(rng, start, width, number)
    sides = (-1, 1)
    if is_corridor(number):
        solids += [p for side in sides for p in _pictures(rng, start, width / 2, side, 5)]
    else:
        solids += [p for side in sides for p in _pictures(rng, start, width / 2, side, 3)]
        solids += [p for side in sides for p in _furniture(rng, start, width / 2, side)]
    panels = [(start + LENGTH * share, 0.0, HEIGHT - 0.03) for share in (0.27, 0.73)]
    shine = Material("glow", (0.98, 0.97, 0.93), emission=1.0)
    lamps = [box("lamp", at, (0.6, 0.6, 0.05), shine) for at in panels]
    lights = [
        Light((x, y, z - 0.05), (0.3, 0, 0), (0, 0.3, 0), (0.0, 0.0, -1.0), (6.0, 5.9, 5.6)) for x, y, z in panels
    ]
    return build_world("building", Scene([*solids, *lamps], lights, NAMES, _COLORS), abs(2 * number + 1), texel)


def _shell(rng: Generator, start: float, width: float, number: int) -> list[Solid]:
    """Floor, ceiling, side walls, and the module's halves of the walls with doors."""
    middle = start + LENGTH / 2
    walls = [Material(*_WALLS[i]) for i in rng.permutation(len(_WALLS))]
    # The wall between a room and a corridor is as wide as the room on both sides of it: nothing shines through.
    across = ROOM_WIDTH + 0.4
    solids = [
        box("floor", (middle, 0, -0.05), (LENGTH, across, 0.1), Material(*_FLOORS[int(rng.integers(3))])),
        box("ceiling", (middle, 0, HEIGHT + 0.05), (LENGTH, across, 0.1), Material("beams", (0.75, 0.7, 0.6))),
    ]
    solids += [
        box("wall", (middle, side * (width / 2 + 0.05), HEIGHT / 2), (LENGTH, 0.1, HEIGHT), walls[side > 0])
        for side in (-1, 1)
    ]
    for x, door in ((start + WALL / 2, number), (start + LENGTH - WALL / 2, number + 1)):
        y = DOOR if door % 2 == 0 else -DOOR
        left, right = y + DOOR_WIDTH / 2, y - DOOR_WIDTH / 2
        for low, high in ((-across / 2, right), (left, across / 2)):
            solids.append(box("wall", (x, (low + high) / 2, HEIGHT / 2), (WALL, high - low, HEIGHT), walls[2]))
        over = HEIGHT - DOOR_HEIGHT
        solids.append(box("wall", (x, y, DOOR_HEIGHT + over / 2), (WALL, DOOR_WIDTH, over), walls[2]))
        poster = Material("poster", tuple(rng.uniform(0.05, 0.8, 3)))
        solids.append(box("picture", (x, -y, 1.5), (WALL + 0.04, rng.uniform(0.6, 1), rng.uniform(0.5, 0.8)), poster))
    return solids


def _pictures(rng: Generator, start: float, half: float, side: int, count: int) -> list[Solid]:
    """Posters along one side wall."""
    edge = Material("wood", (0.16, 0.09, 0.05))
    solids = []
    for k in range(count):
        x = start + LENGTH * (k + 0.5) / count + rng.uniform(-0.2, 0.2)
        wide, tall = rng.uniform(0.4, 0.8), rng.uniform(0.4, 0.7)
        poster = Material("poster", tuple(rng.uniform(0.05, 0.8, 3)))
        faces = {FRONT: poster, BACK: poster}
        solids.append(box("picture", (x, side * (half - 0.02), 1.65), (wide, 0.04, tall), edge, 0.0, faces))
    return solids


def _furniture(rng: Generator, start: float, half: float, side: int) -> list[Solid]:
    """Three pieces along one side, in any order."""
    solids: list[Solid] = []
    for k, kind in enumerate(rng.permutation(4)[:3]):
        x, y = start + LENGTH * (0.2 + 0.3 * k) + rng.uniform(-0.1, 0.1), side * (half - 0.42)
        solids += (_table, _shelf, _boxes, _plant)[kind](rng, x, y, side)
    return solids


def _table(rng: Generator, x: float, y: float, side: int) -> list[Solid]:
    wood = Material("wood", tuple(rng.uniform(0.1, 0.6, 3)))
    yaw = rng.uniform(-0.15, 0.15)
    solids = [box("table", (x, y, 0.72), (1.1, 0.65, 0.05), wood, yaw)]
    solids += [cylinder("table", (x + a, y + b, 0), 0.06, 0.7, wood) for a in (-0.45, 0.45) for b in (-0.22, 0.22)]
    cover = {TOP: Material("poster", tuple(rng.uniform(0.05, 0.6, 3)))}
    solids.append(box("book", (x - 0.2, y, 0.78), (0.3, 0.22, 0.07), wood, rng.uniform(0, 1), cover))
    solids.append(sphere("plant", (x + 0.25, y, 0.9), 0.3, Material("foliage", (0.15, 0.35, 0.1))))
    seat = Material("fabric", tuple(rng.uniform(0.1, 0.5, 3)))
    return [*solids, box("chair", (x, y - side * 0.55, 0.42), (0.42, 0.42, 0.08), seat, rng.uniform(-0.5, 0.5))]


def _shelf(rng: Generator, x: float, y: float, side: int) -> list[Solid]:
    board = Material("wood", tuple(rng.uniform(0.1, 0.6, 3)))
    y += side * 0.22
    solids = [box("shelf", (x, y, z), (1.2, 0.34, 0.03), board) for z in (0.05, 0.55, 1.05, 1.55)]
    solids += [box("shelf", (x + a, y, 0.8), (0.03, 0.34, 1.6), board) for a in (-0.6, 0.6)]
    for z in (0.07, 0.57, 1.07):
        spines = Material("books", tuple(rng.uniform(0.05, 0.3, 3)))
        faces = {FRONT: spines, BACK: spines}
        solids.append(box("book", (x + rng.uniform(-0.1, 0.1), y, z + 0.17), (0.85, 0.22, 0.32), board, 0.0, faces))
    return solids


def _boxes(rng: Generator, x: float, y: float, side: int) -> list[Solid]:
    card = Material("cardboard", tuple(rng.uniform(0.2, 0.5, 3)))
    turns = rng.uniform(-0.4, 0.4, 3)
    return [
        box("box", (x - 0.2, y, 0.25), (0.6, 0.5, 0.5), card, turns[0]),
        box("box", (x - 0.15, y, 0.66), (0.42, 0.38, 0.32), card, turns[1]),
        box("box", (x + 0.42, y, 0.18), (0.4, 0.4, 0.36), card, turns[2]),
    ]


def _plant(rng: Generator, x: float, y: float, side: int) -> list[Solid]:
    leaves = Material("foliage", tuple(rng.uniform(0.08, 0.3, 3)))
    pot = Material("speckle", tuple(rng.uniform(0.1, 0.6, 3)))
    balls = ((0, 0, 0.9, 0.5), (0.16, -0.1, 1.2, 0.42), (-0.15, 0.06, 1.3, 0.4), (0.02, 0.1, 1.55, 0.34))
    return [cylinder("plant", (x, y, 0), 0.4, 0.6, pot)] + [
        sphere("plant", (x + a, y + b, z), d, leaves) for a, b, z, d in balls
    ]


def joined(worlds: list[World]) -> World:
    """Several worlds as one; each keeps its pictures and its light."""
    faces = np.cumsum([0, *(len(w.atlas.texel) for w in worlds)])
    codes = np.cumsum([0, *(len(w.atlas.codes) for w in worlds)])
    deepest = max(w.atlas.levels.shape[1] for w in worlds)
    levels = []
    for w, offset in zip(worlds, codes, strict=False):
        padded = np.zeros((len(w.atlas.texel), deepest, 3), np.int64)
        padded[:, : w.atlas.levels.shape[1]] = w.atlas.levels + np.array([offset, 0, 0])
        levels.append(padded)
    solids = SolidArrays(
        shape=np.concatenate([w.solids.shape for w in worlds]),
        first_face=np.concatenate(
            [w.solids.first_face + np.int32(n) for w, n in zip(worlds, faces, strict=False)]
        ).astype(np.int32),
        **{k: np.concatenate([getattr(w.solids, k) for w in worlds]) for k in ("center", "half", "turn", "bound")},
    )
    atlas = Atlas(
        np.concatenate([w.atlas.codes for w in worlds]),
        np.concatenate(levels),
        np.concatenate([w.atlas.level_count for w in worlds]),
        np.concatenate([w.atlas.texel for w in worlds]),
    )
    return replace(worlds[0], solids=solids, atlas=atlas, labels=np.concatenate([w.labels for w in worlds]))


@lru_cache(maxsize=1)
def around(number: int, texel: float) -> World:
    """All that can be seen from a module."""
    return joined([module(n, texel) for n in range(number - SEEN, number + SEEN + 1)])


def frames(walk: Walk, options: ClipOptions, texel: float = 0.01) -> Iterator[WorldFrame]:
    """The clip, one picture at a time: `options.frames` of them, its walk and laps do not count."""
    for index in range(options.frames):
        time = index / options.fps
        pose = walk.poses(np.array([time]))[0]
        world = around(module_at(pose[0, 3]), texel)
        color, depth, solid_at = render_view(world, options, pose)
        labels = np.append(world.labels, np.uint8(0))[solid_at]
        yield WorldFrame(develop(color, options, index), depth, labels, pose, time)
