"""A classroom: thirty desks on thin legs and their stools over a plain floor, between walls with little on them.

What is hard for depth from pictures: the floor is even and is seen between legs of a few pixels, all desks look alike,
and what lies under a desk is darker than what stands in the light.
"""

import numpy as np
from numpy.typing import NDArray

from tests.world.build import Scene
from tests.world.light import Light
from tests.world.paths import look_at
from tests.world.shapes import BACK, BOTTOM, FRONT, LEFT, RIGHT, ROOM, TOP, Material, Solid, box, cylinder, turned

LENGTH, WIDTH, HEIGHT = 9.2, 7.6, 3.1
ROWS, COLUMNS = 6, 5
LEG = 0.025
CLASSES: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("none", (0, 0, 0)),
    ("wall", (174, 199, 232)),
    ("floor", (152, 223, 138)),
    ("ceiling", (219, 219, 141)),
    ("desk", (255, 152, 150)),
    ("stool", (188, 189, 34)),
    ("blackboard", (31, 119, 180)),
    ("poster", (196, 156, 148)),
    ("door", (214, 39, 40)),
    ("windowpane", (158, 218, 229)),
    ("cabinet", (255, 187, 120)),
    ("book", (23, 190, 207)),
    ("lamp", (255, 240, 60)),
)
_STEEL = Material("plain", (0.12, 0.12, 0.13))


def classroom(blank_walls: bool) -> Scene:
    """The room; `blank_walls` takes the posters down."""
    paint = Material("plain", (0.68, 0.68, 0.6))
    solids = [
        Solid(ROOM, "wall", (0, 0, HEIGHT / 2), (LENGTH, WIDTH, HEIGHT), paint),
        box("floor", (0, 0, -0.04), (LENGTH, WIDTH, 0.1), Material("plain", (0.34, 0.36, 0.33))),
        box("ceiling", (0, 0, HEIGHT + 0.04), (LENGTH, WIDTH, 0.1), Material("plain", (0.78, 0.78, 0.76))),
        *_desks(),
        *_front_wall(),
        *_openings(),
        *([] if blank_walls else _posters()),
    ]
    names, colors = zip(*CLASSES, strict=True)
    return Scene([*solids, *_lamps()], _lights(), names, colors)


def _desks() -> list[Solid]:
    """Rows of desks with a stool each, none quite straight; on some lies a book."""
    rng = np.random.default_rng(30)
    wood, seat = Material("wood", (0.62, 0.46, 0.26)), Material("wood", (0.36, 0.2, 0.1))
    covers = [Material("poster", tone) for tone in ((0.5, 0.1, 0.08), (0.08, 0.2, 0.42), (0.6, 0.5, 0.2))]
    solids: list[Solid] = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            at = (-2.9 + 1.05 * row + rng.normal(0, 0.04), -2.5 + 1.25 * column + rng.normal(0, 0.04))
            yaw = float(rng.normal(0, 0.06))
            solids += [
                box("desk", (*at, 0.735), (0.5, 0.72, 0.03), wood, yaw),
                *_legs("desk", at, yaw, 0.22, 0.33, 0.72),
            ]
            stool, turn = turned(-0.4, float(rng.normal(0, 0.06)), yaw, at), float(rng.normal(0, 0.3))
            solids += [box("stool", (*stool, 0.44), (0.32, 0.32, 0.025), seat, turn)]
            solids += _legs("stool", stool, turn, 0.13, 0.13, 0.43)
            if rng.random() < 0.4:
                x, y = turned(*rng.uniform(-0.12, 0.12, 2).tolist(), yaw, at)
                lid = {TOP: covers[int(rng.integers(3))]}
                solids.append(box("book", (x, y, 0.765), (0.21, 0.15, 0.03), covers[0], float(rng.normal(0, 0.5)), lid))
    return solids


def _legs(label: str, at: tuple[float, float], yaw: float, deep: float, wide: float, height: float) -> list[Solid]:
    corners = [turned(sx * deep, sy * wide, yaw, at) for sx in (-1, 1) for sy in (-1, 1)]
    return [cylinder(label, (x, y, 0.01), LEG, height - 0.01, _STEEL) for x, y in corners]


def _front_wall() -> list[Solid]:
    """A board with a little writing, the teacher's table, and a cabinet in the corner."""
    x = LENGTH / 2 - 0.03
    board = {LEFT: Material("poster", (0.03, 0.1, 0.06))}
    table = (3.35, 0.9)
    return [
        box("blackboard", (x, 0, 1.6), (0.05, 3.2, 1.2), Material("wood", (0.5, 0.4, 0.28)), 0.0, board),
        box("desk", (*table, 0.755), (0.7, 1.5, 0.03), Material("wood", (0.3, 0.17, 0.08))),
        *_legs("desk", table, 0.0, 0.3, 0.7, 0.74),
        box("cabinet", (3.95, -2.9, 0.9), (0.5, 1.1, 1.8), Material("plain", (0.5, 0.52, 0.54))),
    ]


def _openings() -> list[Solid]:
    y = WIDTH / 2
    frame, sky = Material("wood", (0.7, 0.7, 0.68)), Material("window", (0.4, 0.58, 0.85), emission=1.1)
    windows = [
        box("windowpane", (k, y - 0.02, 1.75), (1.6, 0.06, 1.5), frame, 0.0, {FRONT: sky}) for k in (-3, -1, 1, 3)
    ]
    return [*windows, box("door", (3.1, -y + 0.02, 1.05), (0.95, 0.06, 2.1), Material("door", (0.45, 0.5, 0.55)))]


def _posters() -> list[Solid]:
    """Something small on every wall without a window."""
    edge, x, y = Material("wood", (0.16, 0.09, 0.05)), LENGTH / 2 - 0.02, WIDTH / 2 - 0.02
    tones = [Material("poster", tone) for tone in ((0.7, 0.65, 0.5), (0.2, 0.3, 0.5), (0.6, 0.25, 0.15))]
    side = [(-3.4, 1.6, 0.8, 1.0), (-1.6, 1.8, 0.6, 0.5), (0.2, 1.5, 1.1, 0.8)]
    solids = [
        box("poster", (a, -y, z), (w, 0.04, h), edge, 0.0, {BACK: tones[k]}) for k, (a, z, w, h) in enumerate(side)
    ]
    rear = [(-2.2, 1.6, 0.7, 0.9), (0.4, 1.7, 1.4, 0.9), (2.4, 1.5, 0.6, 0.8)]
    return solids + [
        box("poster", (-x, a, z), (0.04, w, h), edge, 0.0, {RIGHT: tones[k]}) for k, (a, z, w, h) in enumerate(rear)
    ]


def _lamps() -> list[Solid]:
    shade, glow = Material("plain", (0.8, 0.8, 0.8)), Material("glow", (1.0, 0.98, 0.94), emission=1.3)
    return [
        box("lamp", (x, y, HEIGHT - 0.06), (1.3, 0.28, 0.08), shade, 0.0, {BOTTOM: glow})
        for x in (-2.6, 0.0, 2.6)
        for y in (-1.7, 1.7)
    ]


def _lights() -> list[Light]:
    return [
        Light((x, y, HEIGHT - 0.11), (0.65, 0, 0), (0, 0.14, 0), (0.0, 0.0, -1.0), (9.0, 8.9, 8.6))
        for x in (-2.6, 0.0, 2.6)
        for y in (-1.7, 1.7)
    ]


def classroom_walk(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam of a walk round the desks along the walls (`steps` counts laps), looking over them."""
    angle = 2 * np.pi * steps
    center = np.stack(
        [
            3.7 * np.cos(angle) * (1 - 0.06 * np.sin(3 * angle)),
            3.0 * np.sin(angle) * (1 - 0.06 * np.sin(3 * angle)),
            1.55 + 0.15 * np.sin(5 * angle),
        ],
        axis=1,
    )
    target = np.stack(
        [-0.9 * np.cos(angle + 0.6), -0.8 * np.sin(angle + 0.6), 0.75 + 0.2 * np.sin(2 * angle)],
        axis=1,
    )
    return look_at(center, target, roll=0.025 * np.sin(4 * angle))
