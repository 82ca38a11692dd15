"""A furnished living room, 6.4 x 5.2 x 2.7 m, round a table."""

import numpy as np

from tests.world.build import Scene
from tests.world.light import Light
from tests.world.shapes import BACK, BOTTOM, FRONT, LEFT, RIGHT, ROOM, TOP, Material, Solid, box, cylinder, sphere
from tests.world.shapes import turned as _turned

LENGTH, WIDTH, HEIGHT = 6.4, 5.2, 2.7
CLASSES: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("none", (0, 0, 0)),
    ("wall", (174, 199, 232)),
    ("floor", (152, 223, 138)),
    ("ceiling", (219, 219, 141)),
    ("table", (255, 152, 150)),
    ("chair", (188, 189, 34)),
    ("sofa", (140, 86, 75)),
    ("cushion", (247, 182, 210)),
    ("shelf", (148, 103, 189)),
    ("book", (23, 190, 207)),
    ("cabinet", (255, 187, 120)),
    ("lamp", (255, 240, 60)),
    ("plant", (44, 160, 44)),
    ("picture", (196, 156, 148)),
    ("rug", (214, 39, 40)),
    ("door", (31, 119, 180)),
    ("window", (158, 218, 229)),
    ("box", (227, 119, 194)),
    ("vase", (127, 127, 127)),
)
OAK, PINE, DARK = (0.42, 0.25, 0.12), (0.6, 0.42, 0.22), (0.16, 0.09, 0.05)


def furnished_room(blank_walls: bool) -> Scene:
    """The room; `blank_walls` paints the walls plainly and takes the pictures down."""
    solids = [_shell(blank_walls)]
    if not blank_walls:
        solids += _wall_pictures()
    solids += _openings() + _table() + _chairs() + _sofa() + _bookshelf() + _cabinet() + _plant() + _corner()
    names, colors = zip(*CLASSES, strict=True)
    return Scene([*solids, *_lamps()], _lights(), names, colors)


def _shell(blank: bool) -> Solid:
    """Walls as one solid; floor and ceiling are thin boxes in front of it, so that they have their own classes."""
    paint = Material("plain", (0.7, 0.68, 0.62))
    walls = {
        RIGHT: Material("wallpaper", (0.45, 0.52, 0.42)),
        LEFT: Material("plaster", (0.72, 0.52, 0.36)),
        BACK: Material("plaster", (0.62, 0.64, 0.66)),
        FRONT: Material("bricks", (0.5, 0.22, 0.15)),
    }
    faces = {} if blank else walls
    return Solid(ROOM, "wall", (0, 0, HEIGHT / 2), (LENGTH, WIDTH, HEIGHT), paint, faces=faces)


def _openings() -> list[Solid]:
    """Floor, ceiling, door and window."""
    x, y = LENGTH / 2, WIDTH / 2
    frame = Material("wood", (0.7, 0.68, 0.64))
    sky = Material("window", (0.35, 0.55, 0.85), emission=1.15)
    return [
        box("floor", (0, 0, -0.04), (LENGTH, WIDTH, 0.1), Material("planks", OAK)),
        box("ceiling", (0, 0, HEIGHT + 0.04), (LENGTH, WIDTH, 0.1), Material("beams", (0.75, 0.7, 0.6))),
        box("rug", (0.0, 0.0, 0.012), (2.7, 1.9, 0.016), Material("rug", (0.5, 0.13, 0.1)), 0.06),
        box("door", (-x + 0.02, 1.55, 1.05), (0.06, 0.95, 2.05), Material("door", (0.5, 0.33, 0.18))),
        box("window", (0.9, y - 0.02, 1.62), (1.9, 0.06, 1.3), frame, 0.0, {FRONT: sky}),
    ]


def _wall_pictures() -> list[Solid]:
    x, y = LENGTH / 2 - 0.02, WIDTH / 2 - 0.02
    edge = Material("wood", DARK)
    on_left = [(-0.35, 1.55, 1.0, 0.75), (-1.5, 1.7, 0.62, 0.85), (0.62, 1.8, 0.5, 0.42)]
    on_front = [(-1.75, 1.62, 0.75, 0.95), (-0.35, 1.75, 1.15, 0.7), (1.1, 1.6, 0.6, 0.8), (2.15, 1.75, 0.7, 0.5)]
    on_back = [(-0.95, 1.7, 0.9, 0.65), (-2.35, 1.75, 0.55, 0.75)]
    on_right = [(-1.75, 1.75, 0.7, 0.85), (1.95, 1.6, 0.6, 0.6)]

    def frame(k: int) -> Material:
        return Material("poster", ((0.1, 0.06, 0.03), (0.65, 0.55, 0.3), (0.75, 0.75, 0.75))[k % 3])

    rows = [(LEFT, RIGHT, a, z, w, h) for a, z, w, h in on_left] + [(RIGHT, LEFT, *p) for p in on_right]
    solids = [
        box("picture", (-x if wall == LEFT else x, a, z), (0.04, w, h), edge, 0.0, {face: frame(k)})
        for k, (wall, face, a, z, w, h) in enumerate(rows)
    ]
    rows = [(FRONT, BACK, a, z, w, h) for a, z, w, h in on_front] + [(BACK, FRONT, *p) for p in on_back]
    return solids + [
        box("picture", (a, -y if wall == FRONT else y, z), (w, 0.04, h), edge, 0.0, {face: frame(k + 1)})
        for k, (wall, face, a, z, w, h) in enumerate(rows)
    ]


def _table() -> list[Solid]:
    top, legs = Material("wood", PINE), Material("wood", OAK)
    solids = [box("table", (0, 0, 0.73), (1.5, 0.85, 0.04), top, 0.1)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = _turned(sx * 0.68, sy * 0.36, 0.1, (0, 0))
            solids.append(cylinder("table", (x, y, 0.02), 0.045, 0.69, legs))
    return [
        *solids,
        cylinder("vase", (-0.42, 0.12, 0.75), 0.15, 0.26, Material("speckle", (0.2, 0.35, 0.6))),
        sphere("plant", (-0.42, 0.12, 1.12), 0.26, Material("foliage", (0.45, 0.12, 0.25))),
        cylinder("vase", (0.45, -0.18, 0.75), 0.3, 0.07, Material("tiles", (0.7, 0.6, 0.5))),
        sphere("vase", (0.4, -0.17, 0.86), 0.095, Material("speckle", (0.6, 0.12, 0.06))),
        sphere("vase", (0.5, -0.2, 0.86), 0.09, Material("speckle", (0.6, 0.45, 0.06))),
        *_pile((0.08, 0.16), 0.75, ((0.2, 0.05, 0.05), (0.06, 0.14, 0.3), (0.5, 0.42, 0.2))),
    ]


def _pile(at: tuple[float, float], height: float, tones: tuple[tuple[float, float, float], ...]) -> list[Solid]:
    """Books on one another."""
    covers = [Material("poster", tone) for tone in tones]
    return [
        box(
            "book",
            (*at, height + 0.02 + 0.04 * k),
            (0.3 - 0.03 * k, 0.22, 0.04),
            Material("wallpaper", tone),
            0.3 - 0.35 * k,
            {TOP: covers[k]},
        )
        for k, tone in enumerate(tones)
    ]


def _chairs() -> list[Solid]:
    return [s for x, y, yaw in ((0.15, 0.78, 0.2), (-1.12, -0.1, 1.75)) for s in _chair((x, y), yaw)]


def _chair(origin: tuple[float, float], yaw: float) -> list[Solid]:
    frame, seat = Material("wood", DARK), Material("fabric", (0.12, 0.3, 0.32))
    solids = [box("chair", (*origin, 0.45), (0.42, 0.42, 0.05), seat, yaw)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = _turned(0.18 * sx, 0.18 * sy, yaw, origin)
            solids.append(cylinder("chair", (x, y, 0), 0.035, 0.43 if sy < 0 else 0.88, frame))
    for z in (0.6, 0.72, 0.84):
        solids.append(box("chair", (*_turned(0, 0.18, yaw, origin), z), (0.38, 0.025, 0.07), frame, yaw))
    return solids


def _sofa() -> list[Solid]:
    cloth, y = Material("fabric", (0.22, 0.26, 0.42)), -WIDTH / 2
    solids = [
        box("sofa", (-0.4, y + 0.48, 0.27), (2.1, 0.8, 0.3), cloth),
        box("sofa", (-0.4, y + 0.16, 0.55), (2.1, 0.24, 0.6), cloth),
        box("sofa", (-1.5, y + 0.46, 0.4), (0.2, 0.86, 0.55), cloth),
        box("sofa", (0.7, y + 0.46, 0.4), (0.2, 0.86, 0.55), cloth),
    ]
    tones = ((0.65, 0.3, 0.12), (0.2, 0.42, 0.25), (0.62, 0.5, 0.2))
    return solids + [
        box("cushion", (-1.15 + 0.68 * k, y + 0.38, 0.58), (0.42, 0.16, 0.36), Material("wallpaper", tone), 0.15 * k)
        for k, tone in enumerate(tones)
    ]


def _bookshelf() -> list[Solid]:
    """Against the +x wall; books stand in four rows."""
    x, y, board = LENGTH / 2 - 0.19, 0.35, Material("wood", OAK)
    solids = [box("shelf", (x + 0.17, y, 1.0), (0.02, 1.7, 2.0), board)]
    solids += [box("shelf", (x, y + side * 0.84, 1.0), (0.34, 0.03, 2.0), board) for side in (-1, 1)]
    solids += [box("shelf", (x, y, z), (0.34, 1.66, 0.03), board) for z in (0.06, 0.5, 0.97, 1.44, 1.98)]
    rows = ((0.08, 0.33, -0.25, 1.1), (0.515, 0.34, 0.2, 1.2), (0.985, 0.33, -0.1, 1.4), (1.455, 0.36, 0.3, 0.95))
    for low, tall, at, width in rows:
        spines = {LEFT: Material("books", DARK)}
        solids.append(box("book", (x + 0.03, y + at, low + tall / 2), (0.22, width, tall), board, 0.0, spines))
    return [*solids, sphere("vase", (x, y - 0.6, 0.62), 0.2, Material("tiles", (0.3, 0.5, 0.55)))]


def _cabinet() -> list[Solid]:
    y = WIDTH / 2 - 0.24
    fronts = {FRONT: Material("door", (0.55, 0.4, 0.22))}
    solids = [
        box("cabinet", (-1.0 + 0.72 * (k - 0.5), y, 0.42), (0.71, 0.44, 0.8), Material("wood", PINE), 0.0, fronts)
        for k in range(2)
    ]
    return [
        *solids,
        cylinder("lamp", (-1.5, y, 0.82), 0.1, 0.24, Material("speckle", (0.3, 0.5, 0.45))),
        cylinder("lamp", (-1.5, y, 1.04), 0.3, 0.24, Material("glow", (0.95, 0.82, 0.55), emission=0.9)),
        *_pile((-0.85, y - 0.02), 0.82, ((0.4, 0.1, 0.05), (0.1, 0.3, 0.25))),
    ]


def _plant() -> list[Solid]:
    x, y = LENGTH / 2 - 0.5, WIDTH / 2 - 0.5
    green = (0.1, 0.28, 0.06)
    balls = ((0, 0, 1.05, 0.5), (0.15, -0.12, 1.35, 0.42), (-0.16, 0.05, 1.4, 0.4), (0.0, 0.1, 1.65, 0.36))
    return [
        cylinder("plant", (x, y, 0), 0.4, 0.42, Material("speckle", (0.5, 0.25, 0.14))),
        cylinder("plant", (x, y, 0.4), 0.05, 0.6, Material("wood", OAK)),
        *(sphere("plant", (x + a, y + b, z), d, Material("foliage", green)) for a, b, z, d in balls),
    ]


def _corner() -> list[Solid]:
    """Moving boxes and a ball in one corner."""
    x, y = LENGTH / 2 - 0.45, -WIDTH / 2 + 0.45
    card = (0.5, 0.35, 0.2)
    return [
        box("box", (x, y, 0.25), (0.6, 0.5, 0.48), Material("cardboard", card), 0.2),
        box("box", (x + 0.05, y, 0.65), (0.42, 0.38, 0.32), Material("cardboard", card), -0.3),
        box("box", (x - 0.65, y - 0.1, 0.18), (0.4, 0.4, 0.34), Material("cardboard", card), 0.5),
        sphere("vase", (-2.6, -1.95, 0.26), 0.5, Material("tiles", (0.6, 0.2, 0.15))),
    ]


def _lamps() -> list[Solid]:
    shade = Material("glow", (0.95, 0.85, 0.62), emission=0.95)
    return [
        box(
            "lamp",
            (0, 0, HEIGHT - 0.05),
            (1.3, 0.5, 0.04),
            Material("glow", (0.97, 0.96, 0.92), emission=1.0),
            0.0,
            {BOTTOM: Material("glow", (1.0, 0.99, 0.95), emission=1.0)},
        ),
        cylinder("lamp", (-2.75, 0.62, 0), 0.3, 0.04, Material("wood", DARK)),
        cylinder("lamp", (-2.75, 0.62, 0.04), 0.03, 1.4, Material("wood", DARK)),
        cylinder("lamp", (-2.75, 0.62, 1.4), 0.38, 0.3, shade),
    ]


def _lights() -> list[Light]:
    warm, day, lamp = np.array((5.2, 4.9, 4.4)), np.array((3.4, 3.9, 4.6)), np.array((6.0, 4.6, 2.8))
    down, inwards, around = (0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)
    return [
        Light((0, 0, HEIGHT - 0.08), (0.65, 0, 0), (0, 0.25, 0), down, tuple(warm)),
        Light((0.9, WIDTH / 2 - 0.07, 1.62), (0.9, 0, 0), (0, 0, 0.6), inwards, tuple(day)),
        Light((-2.75, 0.62, 1.55), (0.1, 0, 0), (0, 0.1, 0), around, tuple(lamp)),
        Light((-1.5, WIDTH / 2 - 0.24, 1.16), (0.08, 0, 0), (0, 0.08, 0), around, tuple(lamp)),
    ]
