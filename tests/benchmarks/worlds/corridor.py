"""A square ring of corridor whose four sides look alike: the trap for whoever closes loops by appearance alone.

Doors and posters repeat every two metres with the very same pictures. What differs from side to side is one picture
each, and the wear of the plaster and the floor.
"""

import numpy as np
from numpy.typing import NDArray

from tests.world.build import Scene
from tests.world.light import Light
from tests.world.paths import EYE_HEIGHT, look_at
from tests.world.room import DARK, OAK
from tests.world.shapes import BACK, FRONT, LEFT, RIGHT, ROOM, Material, Solid, box, cylinder

OUTER, INNER, HEIGHT = 9.0, 5.4, 2.6
CLASSES: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("none", (0, 0, 0)),
    ("wall", (174, 199, 232)),
    ("floor", (152, 223, 138)),
    ("ceiling", (219, 219, 141)),
    ("door", (31, 119, 180)),
    ("picture", (196, 156, 148)),
    ("lamp", (255, 240, 60)),
    ("radiator", (140, 86, 75)),
    ("bin", (188, 189, 34)),
    ("skirting", (255, 187, 120)),
    ("sign", (227, 119, 194)),
)


def ring_corridor(blank_walls: bool, blank_sides: tuple[int, ...] = ()) -> Scene:
    """The ring; `blank_walls` leaves the plaster off and the repeated doors and posters on, which `blank_sides` (of 0
    to 3) do without; where there are any the floor is plain as well."""
    kind = "plain" if blank_walls else "plaster"
    floor = "plain" if blank_sides else "tiles"
    paint = Material(kind, (0.66, 0.64, 0.56))
    solids = [
        Solid(ROOM, "wall", (0, 0, HEIGHT / 2), (OUTER, OUTER, HEIGHT), paint),
        box("wall", (0, 0, HEIGHT / 2), (INNER, INNER, HEIGHT), paint),
        box("floor", (0, 0, -0.04), (OUTER, OUTER, 0.1), Material(floor, (0.42, 0.36, 0.3))),
        box("ceiling", (0, 0, HEIGHT + 0.04), (OUTER, OUTER, 0.1), Material(kind, (0.72, 0.72, 0.7))),
    ]
    lights: list[Light] = []
    for side in range(4):
        if side not in blank_sides:
            solids += _outer_side(side) + _inner_side(side)
        for along in (-2.6, 0.0, 2.6):
            lamp, light = _ceiling_lamp(side, along)
            solids.append(lamp)
            lights.append(light)
    names, colors = zip(*CLASSES, strict=True)
    return Scene(solids, lights, names, colors)


def _placed(side: int, along: float, across: float, z: float) -> tuple[float, float, float]:
    """World point of a side's own coordinates; side 0 runs along +x at y = -across."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[side]
    return c * along + s * across, s * along - c * across, z


def _on_wall(
    side: int, outer: bool, label: str, along: float, z: float, size: tuple[float, float], material: Material
) -> Solid:
    """A flat thing on the outer or inner wall of a side; its picture faces the corridor."""
    wide, tall = size
    depth = 0.05
    across = OUTER / 2 - 0.02 if outer else INNER / 2 + 0.02
    extent = (wide, depth, tall) if side % 2 == 0 else (depth, wide, tall)
    inwards = (BACK, LEFT, FRONT, RIGHT)[side]
    outwards = (FRONT, RIGHT, BACK, LEFT)[side]
    face = inwards if outer else outwards
    center = _placed(side, along, across, z)
    return box(label, center, extent, Material("wood", DARK), 0.0, {face: material})


def _outer_side(side: int) -> list[Solid]:
    solids = []
    for k, along in enumerate((-3.0, -1.0, 1.0, 3.0)):
        door = Material("door", (0.36, 0.2, 0.1), twin=1)
        poster = Material("poster", (0.1, 0.06, 0.03), twin=2 + k % 2)
        solids.append(_on_wall(side, True, "door", along, 1.02, (0.9, 2.0), door))
        solids.append(_on_wall(side, True, "picture", along + 0.85, 1.5, (0.55, 0.75), poster))
    own = Material("poster", (0.7, 0.7, 0.66))
    return [*solids, _on_wall(side, True, "sign", -3.85, 1.6, (0.5, 0.4), own)]


def _inner_side(side: int) -> list[Solid]:
    solids = []
    for along in (-1.6, 0.4):
        solids.append(
            _on_wall(side, False, "radiator", along, 0.45, (0.9, 0.6), Material("tiles", (0.6, 0.6, 0.58), twin=5))
        )
        solids.append(
            _on_wall(side, False, "picture", along, 1.55, (0.8, 0.6), Material("poster", (0.6, 0.5, 0.3), twin=6))
        )
        x, y, _ = _placed(side, along + 0.95, INNER / 2 + 0.2, 0)
        solids.append(cylinder("bin", (x, y, 0), 0.28, 0.42, Material("speckle", (0.25, 0.4, 0.5), twin=7)))
    skirting = Material("wood", OAK, twin=8)
    return [*solids, _on_wall(side, False, "skirting", 0, 0.07, (INNER, 0.14), skirting)]


def _ceiling_lamp(side: int, along: float) -> tuple[Solid, Light]:
    at = _placed(side, along, (OUTER + INNER) / 4, HEIGHT - 0.05)
    panel = box("lamp", at, (0.6, 0.6, 0.05), Material("glow", (0.98, 0.97, 0.93), emission=1.0))
    radiance = tuple(np.array((5.0, 4.9, 4.6)))
    below = (at[0], at[1], HEIGHT - 0.09)
    return panel, Light(below, (0.3, 0, 0), (0, 0.3, 0), (0.0, 0.0, -1.0), radiance)


def corridor_walk(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam of a walk through the ring, looking ahead and a little to the outer wall."""
    center = np.concatenate([_ring(steps), np.full((len(steps), 1), EYE_HEIGHT)], axis=1)
    center[:, 2] += 0.04 * np.sin(18 * np.pi * steps)
    ahead = np.concatenate([_ring(steps + 0.055), np.full((len(steps), 1), 1.3)], axis=1)
    outwards = center[:, :2] / np.linalg.norm(center[:, :2], axis=1, keepdims=True)
    ahead[:, :2] += outwards * (0.35 + 0.25 * np.sin(10 * np.pi * steps))[:, None]
    return look_at(center, ahead, roll=0.015 * np.sin(12 * np.pi * steps))


def _ring(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) points on a square with rounded corners in the middle of the corridor."""
    half = (OUTER + INNER) / 4
    angle = 2 * np.pi * (steps - 0.125)
    # A superellipse: between a circle (2) and a square (infinity), with even curvature changes.
    c, s = np.cos(angle), np.sin(angle)
    radius = half / (np.abs(c) ** 7 + np.abs(s) ** 7) ** (1 / 7)
    return np.stack([radius * c, radius * s], axis=1)
