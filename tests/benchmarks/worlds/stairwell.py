"""A stairwell: balustrades of thin bars with gaps between them, things behind them, and a polished floor that mirrors.

What is hard for depth from pictures, and measured nowhere else: bars of a few pixels whose window is mostly what lies
behind, gaps that a smooth surface would close, even walls, and a mirror image below the floor that matches very well.
"""

import numpy as np
from numpy.typing import NDArray

from tests.world.build import Scene
from tests.world.light import Light
from tests.world.paths import look_at
from tests.world.shapes import FRONT, RIGHT, ROOM, TOP, Material, Solid, box, cylinder, sphere

LENGTH, WIDTH, HEIGHT = 6.4, 4.8, 4.2
STEPS, TREAD, RISE = 12, 0.28, 0.17
EDGE, FOOT = 1.2, -1.9
"""y of the stairs' open side, x of their lowest step."""
GLOSS = 0.12
"""Of the floor, seen from straight above: lacquered wood has 0.04, polished stone more."""
CLASSES: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("none", (0, 0, 0)),
    ("wall", (174, 199, 232)),
    ("floor", (152, 223, 138)),
    ("ceiling", (219, 219, 141)),
    ("stairs", (255, 187, 120)),
    ("bar", (31, 119, 180)),
    ("rail", (148, 103, 189)),
    ("picture", (196, 156, 148)),
    ("chest", (140, 86, 75)),
    ("plant", (44, 160, 44)),
    ("box", (227, 119, 194)),
)
BAR = 5
"""The class of the thin bars."""
_IRON, _OAK = Material("speckle", (0.05, 0.05, 0.05)), Material("wood", (0.36, 0.2, 0.1))


def stairwell(blank_walls: bool) -> Scene:
    """The hall; its walls are even, `blank_walls` takes the pictures down as well."""
    plain = Material("plain", (0.72, 0.7, 0.64))
    solids = [
        # Its own floor lies below the boards.
        Solid(ROOM, "wall", (0, 0, HEIGHT / 2 - 0.1), (LENGTH, WIDTH, HEIGHT + 0.2), plain),
        box("floor", (0, 0, -0.05), (LENGTH, WIDTH, 0.1), Material("planks", (0.4, 0.24, 0.12))),
        box("ceiling", (0, 0, HEIGHT), (LENGTH, WIDTH, 0.1), plain),
        *_stairs(),
        *_banister(),
        *_behind(),
        *([] if blank_walls else _pictures()),
    ]
    names, colors = zip(*CLASSES, strict=True)
    lamps = [(-1.0, 0.2, HEIGHT - 0.05), (1.6, -0.6, HEIGHT - 0.05)]
    lights = [Light(at, (0.5, 0, 0), (0, 0.4, 0), (0.0, 0.0, -1.0), (8.0, 7.6, 7.0)) for at in lamps]
    return Scene(solids, lights, names, colors)


def _stairs() -> list[Solid]:
    """Steps along the far wall up to a landing, with two bars a step and a rail of short pieces."""
    back, solids = WIDTH / 2, []
    y, deep = (EDGE + back) / 2, back - EDGE
    for k in range(STEPS):
        x, top = FOOT + (k + 0.5) * TREAD, (k + 1) * RISE
        solids.append(box("stairs", (x, y, top - RISE / 2), (TREAD, deep, RISE), _OAK))
        for along in (-0.25, 0.25):
            foot = (x + along * TREAD, EDGE + 0.04)
            solids.append(cylinder("bar", (*foot, top), 0.02, 0.84 + along * RISE, _IRON))
    pieces = np.linspace(FOOT, FOOT + STEPS * TREAD, 4 * STEPS)
    for x in pieces.tolist():
        height = (x - FOOT) / TREAD * RISE + 0.95
        solids.append(box("rail", (x, EDGE + 0.04, height), (0.08, 0.05, 0.06), _OAK))
    end, top = FOOT + STEPS * TREAD, STEPS * RISE
    wide = LENGTH / 2 - end
    solids.append(box("stairs", (end + wide / 2, y, top - 0.1), (wide, deep, 0.2), _OAK))
    solids.append(box("rail", (end + wide / 2, EDGE + 0.04, top + 0.95), (wide, 0.05, 0.06), _OAK))
    across = np.arange(end + 0.1, LENGTH / 2 - 0.05, 0.11).tolist()
    return solids + [cylinder("bar", (x, EDGE + 0.04, top), 0.016, 0.93, _IRON) for x in across]


def _banister() -> list[Solid]:
    """A free-standing balustrade before the stairs: bars of 1 to 4 cm, gaps of 6 to 16 cm."""
    y, left, right = -0.15, -1.1, 1.5
    solids = [box("rail", ((left + right) / 2, y, z), (right - left, 0.05, 0.05), _OAK) for z in (0.12, 0.98)]
    solids += [box("rail", (x, y, 0.52), (0.08, 0.08, 1.04), _OAK) for x in (left, right)]
    x, pale = left + 0.12, Material("wood", (0.6, 0.5, 0.36))
    for k in range(100):
        thick = 0.01 * (1 + k % 4)
        if x > right - 0.08:
            break
        solids.append(box("bar", (x, y, 0.55), (thick, thick, 0.82), (_IRON, pale)[k // 4 % 2]))
        x += thick + (0.06, 0.11, 0.16)[k % 3]
    return solids


def _pictures() -> list[Solid]:
    edge, y = Material("wood", (0.16, 0.09, 0.05)), WIDTH / 2 - 0.02
    faces = [Material("poster", tone) for tone in ((0.6, 0.5, 0.3), (0.1, 0.06, 0.03), (0.7, 0.7, 0.68))]
    hung = [(-2.4, 1.5, 0.7, 0.9), (-0.9, 2.3, 0.9, 0.7), (0.4, 3.0, 0.6, 0.8), (2.2, 1.3, 0.9, 0.7)]
    solids = [
        box("picture", (x, y, z), (w, 0.04, h), edge, 0.0, {FRONT: faces[k % 3]}) for k, (x, z, w, h) in enumerate(hung)
    ]
    return [*solids, box("picture", (-LENGTH / 2 + 0.02, 0.3, 1.6), (0.04, 1.0, 0.8), edge, 0.0, {RIGHT: faces[1]})]


def _behind() -> list[Solid]:
    """What is seen through the gaps."""
    lid = {TOP: Material("rug", (0.4, 0.1, 0.1))}
    return [
        box("chest", (0.1, 0.75, 0.28), (0.9, 0.45, 0.52), Material("wood", (0.6, 0.42, 0.22)), 0.1, lid),
        cylinder("plant", (1.25, 0.6, 0.0), 0.32, 0.36, Material("speckle", (0.5, 0.25, 0.14))),
        sphere("plant", (1.25, 0.6, 0.66), 0.55, Material("foliage", (0.1, 0.28, 0.06))),
        box("box", (2.3, 0.2, 0.22), (0.45, 0.5, 0.44), Material("cardboard", (0.5, 0.35, 0.2)), 0.3),
        box("box", (-2.5, 0.5, 0.25), (0.4, 0.4, 0.5), Material("cardboard", (0.5, 0.35, 0.2)), -0.2),
    ]


def stairwell_walk(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam past the balustrades and back (`steps` 0 to 1), the hand going up and down."""
    angle = 2 * np.pi * steps
    center = np.stack([-1.7 * np.cos(angle), -1.75 + 0.3 * np.sin(2 * angle), 1.5 + 0.25 * np.sin(3 * angle)], axis=1)
    target = np.stack(
        [-0.5 * np.cos(angle), np.full_like(angle, 0.9), 1.0 + 0.2 * np.sin(2 * angle + 0.5)],
        axis=1,
    )
    return look_at(center, target, roll=0.02 * np.sin(4 * angle))
