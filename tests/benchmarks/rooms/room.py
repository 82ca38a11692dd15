"""A room by seed: walls, openings, light and furniture, lit and ready to be photographed."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .furniture import Catalogue, Piece
from .pieces import SIZES, Style, build_piece
from .surfaces import UP, Array, Opening, Surfaces, Trim, Wall, build_wall, standing
from .textures import WOODS, Random, carpet, color, linear, paper, pick, picture, tiles, wood
from .wet import WET, furnish_wet

KINDS = {"home": 0.55, "office": 0.2, "class": 0.15, "bare": 0.1}


@dataclass
class Room:
    """What is known while it is built; `taken` holds (x0, z0, x1, z1) of what stands on the floor, `entries` of what is
    kept free before doors, `tops` the frames and sizes of what things can lie on. Of a home's room: the `doors` of each
    of its walls to other rooms, the trim and the walls' material of the home, and where a wall has nothing behind."""

    kind: str
    size: tuple[float, float, float]
    surfaces: Surfaces
    catalogue: Catalogue
    doors: tuple[list[Opening], ...] = ([], [], [], [])
    trim: Trim | None = None
    paint: int | None = None
    is_outside: Callable[[int, Opening], bool] = lambda wall, opening: True
    walls: list[Wall] = field(default_factory=list)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)
    entries: list[tuple[float, float, float, float]] = field(default_factory=list)
    tops: list[tuple[Array, float, float, float]] = field(default_factory=list)

    def is_free(self, x0: float, z0: float, x1: float, z1: float, gap: float) -> bool:
        """Whether a rectangle of the floor is inside and `gap` away from all that stands there."""
        wide, deep, _ = self.size
        inside = x0 > -0.01 and z0 > -0.01 and x1 < wide + 0.01 and z1 < deep + 0.01
        others = self.taken + self.entries
        return inside and all(x1 + gap < a or x0 - gap > c or z1 + gap < b or z0 - gap > d for a, b, c, d in others)

    def allows(self, wall: int, hole: Opening) -> bool:
        """Whether a wall has place for a window or door beside those to other rooms."""
        beside = all(hole.right + 0.3 < d.left or hole.left - 0.3 > d.right for d in self.doors[wall])
        return beside and ((hole.kind == "door" and self.kind != "stairs") or self.is_outside(wall, hole))


def build_room(seed: int, catalogue: Catalogue, kind: str = "") -> tuple[Room, Random]:
    """The room of a seed, and the source of chance for what follows; `kind` other than that of the seed: of WET."""
    r = np.random.default_rng(seed)
    kind = kind or _kind(r)
    size = r.uniform(3, 6.5), r.uniform(3.2, 7.5), r.uniform(2.3, 3.2)
    if kind == "class":
        size = r.uniform(5.5, 9), r.uniform(6, 10), r.uniform(2.7, 3.6)
    if kind in WET:
        wide, deep = (float(r.uniform(*limits)) for limits in WET[kind])
        size = wide, deep, size[2]
    room = Room(kind, size, Surfaces(), catalogue)
    if kind in WET and r.random() < 0.6:
        room.paint = room.surfaces.material((1, 1, 1), *tiles(r, color(r, "wall")))
    fill_room(room, r)
    return room, r


def fill_room(room: Room, r: Random) -> None:
    """Build its walls, light and furniture."""
    _build_shell(room, r)
    _hang_lights(room, r)
    Furnisher(room, r).furnish()


def kind_of(seed: int) -> str:
    """The kind of the room of a seed, without building it."""
    return _kind(np.random.default_rng(seed))


def _kind(r: Random) -> str:
    return str(r.choice(list(KINDS), p=list(KINDS.values())))


def surface(s: Surfaces, r: Random, kind: str) -> int:
    """Material of a wall or floor."""
    texture, rgb = pick(r, kind), color(r, kind)
    gloss = r.uniform(0.05, 0.35) if kind == "floor" and r.random() < 0.35 else 0.0
    if texture is wood:
        rgb = np.array(WOODS[r.integers(len(WOODS))]) * r.uniform(0.7, 1.1)
    if texture is None:
        return s.material(linear(rgb * 255), gloss=gloss)
    image, span = texture(r, rgb)
    spread = float((image.std((0, 1)) / image.mean((0, 1))).mean())
    return s.material((1, 1, 1), image, span, gloss=gloss, wear=float(np.clip(spread, 0.008, 0.04)) if s.worn else 0.0)


def thing_material(s: Surfaces, r: Random, wooden: float = 0.4) -> int:
    """Material of furniture."""
    if r.random() < wooden:
        rgb = np.array(WOODS[r.integers(len(WOODS))]) * r.uniform(0.6, 1.1)
        if r.random() < 0.25:
            return s.material(linear(rgb * 255))
        return s.material((1, 1, 1), *wood(r, rgb))
    texture, rgb = pick(r, "thing"), color(r, "thing")
    return s.material(linear(rgb * 255)) if texture is None else s.material((1, 1, 1), *texture(r, rgb))


def _build_shell(room: Room, r: Random) -> None:
    s, (wide, deep, high) = room.surfaces, room.size
    one = surface(s, r, "wall") if room.paint is None else room.paint
    materials = [one if r.random() < 0.8 else surface(s, r, "wall") for _ in range(4)]
    white = s.material(linear(np.full(3, r.uniform(200, 248))))
    ceiling = white if r.random() < 0.7 else surface(s, r, "wall")
    s.of_class("floor")
    s.quad((0, 0, deep), (wide, 0, 0), (0, 0, -deep), surface(s, r, "floor"))
    s.of_class("ceiling")
    s.quad((0, high, 0), (wide, 0, 0), (0, 0, deep), ceiling)
    trim = room.trim or make_trim(room, r)
    corners = ((0, 0, 0), (wide, 0, 0), (wide, 0, deep), (0, 0, deep))
    ways = ((1, 0, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -1))
    for i, (corner, way, length) in enumerate(zip(corners, ways, (wide, deep, wide, deep), strict=True)):
        along, inward = np.array(way, float), np.array(ways[(i + 1) % 4], float)
        holes = [o for o in _openings(length, high, r) if room.allows(i, o)] + room.doors[i]
        wall = Wall(np.array(corner, float), along, length, inward, holes)
        build_wall(s, wall, high, materials[i], trim, r)
        room.walls.append(wall)
        _skirting(room, wall, trim, r)
    s.of_class("wall")
    if not any(room.doors) and r.random() < 0.45:  # a corner block makes the room L-shaped; or a pillar
        corner_block = r.random() < 0.6
        shares = (r.uniform(0.3, 0.45) * wide, r.uniform(0.2, 0.45) * deep)
        a, b = shares if corner_block else (r.uniform(0.25, 0.6), r.uniform(0.25, 0.6))
        x, z = r.choice([0, wide - a]), r.choice([0, deep - b])
        s.box((x, 0, z), (x + a, high, z + b), one)
        room.taken.append((x, z, x + a, z + b))
    if r.random() < 0.25:
        s.box((0, high - r.uniform(0.15, 0.4), deep * 0.5), (wide, high, deep * 0.5 + r.uniform(0.15, 0.4)), ceiling)


def make_trim(room: Room, r: Random) -> Trim:
    """Materials of frames, doors and metal, and what is outside."""
    s = room.surfaces
    light = r.uniform(1.5, 6) * np.array([1, 1, 1.05])
    if r.random() < 0.5:
        sky = s.material((0.5,) * 3, emission=2 * light * r.choice([0.15, 0.5, 1]))
    else:
        sky = s.material((1, 1, 1), picture(r, room.catalogue.textures), emission=light * r.uniform(0.1, 0.6))
    plain = s.material(linear(color(r, "wall") * 255))
    frame = plain if r.random() < 0.7 else thing_material(s, r)
    return Trim(frame, thing_material(s, r), s.material((0.4, 0.4, 0.4)), sky, light)


def _openings(length: float, high: float, r: Random) -> list[Opening]:
    out, x = [], r.uniform(0.2, 1)
    while x < length - 1.1:
        dice = r.random()
        if dice < 0.25:
            width, low = (
                min(r.uniform(0.8, 2.6), length - x - 0.15),
                r.choice([r.uniform(0.7, 1.1), 0.02], p=[0.85, 0.15]),
            )
            out.append(Opening(x, low, x + width, min(r.uniform(low + 0.9, 2.5), high - 0.1), "window"))
            x += width + r.uniform(0.15, 1.2)
        elif dice < 0.4:
            width, kind = r.uniform(0.75, 1), "door" if r.random() < 0.6 else "doorway"
            out.append(Opening(x, 0, x + width, min(2.05, high - 0.1), kind))
            x += width + r.uniform(0.3, 1.5)
        else:
            x += r.uniform(0.5, 2)
    return out


def _skirting(room: Room, wall: Wall, trim: Trim, r: Random) -> None:
    """The board along the wall's foot; and doors are kept free."""
    doors = sorted((h for h in wall.openings if h.kind != "window"), key=lambda h: h.left)
    if r.random() < 0.6:
        high, x = r.uniform(0.05, 0.14), 0.0
        room.surfaces.of_class("wall")
        for left, right in [(h.left, h.right) for h in doors] + [(wall.length, wall.length)]:
            room.surfaces.box((x, 0, 0), (left, high, 0.015), trim.frame, wall.frame)
            x = right
    for h in doors:
        c = wall.origin + wall.along * (h.left + h.right) / 2 + wall.inward * 0.4
        room.entries.append((c[0] - 0.45, c[2] - 0.45, c[0] + 0.45, c[2] + 0.45))


def _hang_lights(room: Room, r: Random) -> None:
    s, (wide, deep, high) = room.surfaces, room.size
    s.of_class("lamp")
    rim = s.material((0.8, 0.8, 0.8))
    glow = r.uniform(4, 16) * np.array([1, r.uniform(0.9, 1), r.uniform(0.75, 1)])
    for _ in range(int(r.integers(1, 3)) if room.kind != "class" else int(r.integers(3, 7))):
        a, b = min(r.uniform(0.2, 1.2), wide - 0.5), r.uniform(0.2, 0.6)
        x, z = r.uniform(0.2, wide - a - 0.2), r.uniform(0.2, deep - b - 0.2)
        drop = 0.04 if r.random() < 0.7 else r.uniform(0.2, 0.7)
        s.new_thing()
        s.quad((x, high - drop, z), (a, 0, 0), (0, 0, b), s.material((0.5,) * 3, emission=2 * glow), light=glow)
        s.box((x - 0.03, high - drop - 0.005, z - 0.03), (x + a + 0.03, high - drop + 0.04, z + b + 0.03), rim,
              faces=(0, 1, 4, 5))  # fmt: skip
        if drop > 0.04:
            s.box((x + a / 2, high - drop, z + b / 2), (x + a / 2 + 0.01, high, z + b / 2 + 0.01), rim)


class Furnisher:
    """Puts things where there is place."""

    def __init__(self, room: Room, r: Random) -> None:
        self.room, self.r, self.s = room, r, room.surfaces
        pieces = room.catalogue.pieces
        self.large = [
            p for p in pieces
            if p.category != "Lights" and p.size[1] > 0.35 and max(p.size[0], p.size[2]) > 0.3 and max(p.size) < 3.2
            and p.elevation < 0.25 and p.movable
        ]  # fmt: skip
        self.small = [p for p in pieces if max(p.size) < 0.6 and p.elevation < 0.25]
        self.hung = [p for p in pieces if 0.6 < p.elevation < 1.8 and p.size[2] < 0.6]
        self.chairs = [p for p in pieces if "chair" in p.name.lower() and p.elevation < 0.2 and max(p.size) < 1.3]
        plain = [self.s.material(linear(color(r, "thing") * 255)) for _ in range(8)]
        self.books = plain + [self.s.material((1, 1, 1), picture(r, room.catalogue.textures)) for _ in range(4)]

    def furnish(self) -> None:
        """Everything, from large to small."""
        r, room = self.r, self.room
        if room.kind == "class":
            self._rows_of_desks()
        if room.kind in WET:
            furnish_wet(self)
        kinds = ["cupboard", "cupboard", "shelf", "desk", "sofa", "bed", "radiator", "box", "curtain", "lamp"]
        narrow = room.kind in ("corridor", "stairs")
        if narrow:
            kinds = ["shelf", "radiator", "box", "lamp"]
        few = room.kind in ("bare", *WET) or narrow
        for _ in range(int(r.integers(1, 6)) if few else int(r.integers(18, 45))):
            if narrow or r.random() < 0.5 or not self.large:
                self._against_wall(str(r.choice(kinds)))
            else:
                self._against_wall(self.large[r.integers(len(self.large))])
        if room.kind in ("home", "office", "kitchen"):
            for _ in range(int(r.integers(4, 14))):
                self._in_the_room()
        for frame, w, h, d in room.tops:
            for _ in range(int(r.poisson(1.6))):
                self._on_top(frame, w, h, d)
        for wall in room.walls:
            for _ in range(int(r.poisson(1.4))):
                self._on_wall(wall)
        for _ in range(int(r.poisson(4.0))):
            self._on_floor()
        if r.random() < 0.4:
            self._rug()

    def named(self, words: str) -> list[Piece]:
        """The pieces of the catalogue with such names."""
        return [p for p in self.room.catalogue.pieces if re.search(words, p.name, re.IGNORECASE)]

    def style(self, kind: str) -> Style:
        """Size and materials by chance."""
        w, h, d = (float(self.r.uniform(*limits)) for limits in SIZES.get(kind, SIZES["box"]))
        first, second = thing_material(self.s, self.r), thing_material(self.s, self.r)
        return Style((w, h, d), first, second, thing_material(self.s, self.r, 0.1), self.books)

    def put(self, what: str | Piece, frame: Array, style: Style | None = None, scale: float = 1.0) -> None:
        """Add a thing whose back stands at the frame's origin."""
        if isinstance(what, str):
            self.s.new_thing()
            build_piece(self.s, what, style or self.style(what), frame, self.r)
            return
        self.s.of_class(what.kind)
        self.s.new_thing()
        recolored, numbers = self.r.random() < 0.5, []
        for rgb, texture in what.materials:
            own = color(self.r, "thing") if recolored else np.array(rgb)
            image = self.room.catalogue.textures[texture] if texture >= 0 else None
            numbers.append(self.s.material(np.clip(linear(own * 255), 0.02, 0.9), image))
        turn = frame[:3, :3].T.astype(np.float32)
        points = what.triangles * np.float32(scale) + np.float32([0, 0, what.size[2] / 2 * scale])
        shape = points @ turn + frame[:3, 3].astype(np.float32), what.places
        self.s.add(*shape, np.array(numbers, np.int32)[what.material], what.normals @ turn)

    def stand(
        self, x: float, z: float, angle: float, what: str | Piece, style: Style | None = None, gap: float = 0.02
    ) -> Array | None:
        """Put a thing with the middle of its back at (x, z) where there is place; its frame."""
        style = style or (self.style(what) if isinstance(what, str) else None)
        w, h, d = style.size if style is not None else what.size  # type: ignore[union-attr]
        fx, fz = math.sin(angle), math.cos(angle)
        c, s = abs(fz), abs(fx)
        a, b = (w * c + d * s) / 2, (w * s + d * c) / 2
        mx, mz = x + fx * d / 2, z + fz * d / 2
        if not self.room.is_free(mx - a, mz - b, mx + a, mz + b, gap):
            return None
        frame = standing(x, 0, z, angle)
        self.put(what, frame, style)
        self.room.taken.append((mx - a, mz - b, mx + a, mz + b))
        if what in ("table", "desk", "cupboard", "box") and h < 1.3:
            self.room.tops.append((frame, w, h, d))
        return frame

    def _against_wall(self, what: str | Piece) -> None:
        r, wall = self.r, self.room.walls[int(self.r.integers(4))]
        style = self.style(what) if isinstance(what, str) else None
        w, h, _ = style.size if style is not None else what.size  # type: ignore[union-attr]
        if w > wall.length - 0.1:
            return
        u = r.uniform(w / 2, wall.length - w / 2)
        covers = any(o.left < u + w / 2 and o.right > u - w / 2 and o.low < h for o in wall.openings)
        if h > 0.8 and covers and r.random() < 0.8:
            return
        p = wall.origin + wall.along * u + wall.inward * (0.018 + abs(r.normal() * 0.025))
        self.stand(p[0], p[2], math.atan2(wall.inward[0], wall.inward[2]), what, style)

    def _in_the_room(self) -> None:
        r, (wide, deep, _) = self.r, self.room.size
        x, z, dice = r.uniform(1, wide - 1), r.uniform(1, deep - 1), r.random()
        angle = r.choice([0, 1, 2, 3]) * math.pi / 2 + r.normal() * 0.08
        if dice < 0.45:
            style = self.style("table")
            if (frame := self.stand(x, z, angle, "table", style, gap=0.3)) is not None and style.size[1] > 0.6:
                self._chairs_around(frame, style, angle)
        elif dice < 0.85 and self.large:
            self.stand(x, z, angle, self.large[r.integers(len(self.large))], gap=0.3)
        else:
            self.stand(x, z, angle, str(r.choice(["rail", "box", "shelf", "sofa", "lamp"])), gap=0.3)

    def _chairs_around(self, frame: Array, table: Style, angle: float) -> None:
        r, (w, _, d) = self.r, table.size
        made = "chair" if r.random() < 0.5 or not self.chairs else self.chairs[r.integers(len(self.chairs))]
        style = self.style("chair") if made == "chair" else None
        for k in range(int(r.integers(0, 5))):
            x, z = r.uniform(-w / 2 + 0.25, w / 2 - 0.25), -0.35 if k % 2 == 0 else d + 0.35
            p = frame @ np.array([x, 0, z, 1])
            turned = angle + (0 if k % 2 == 0 else math.pi) + r.normal() * 0.15
            self.stand(p[0], p[2], turned, made, style, gap=-0.2)

    def _rows_of_desks(self) -> None:
        r, (wide, deep, _) = self.r, self.room.size
        desk, chair = self.style("desk"), self.style("chair")
        across, along = desk.size[0] + r.uniform(0.15, 0.7), desk.size[2] + r.uniform(0.6, 0.9)
        for z in np.arange(r.uniform(1.2, 2.2), deep - 1.2, along):
            for x in np.arange(r.uniform(0.6, 1.2), wide - 0.8, across):
                if r.random() < 0.9:
                    self.stand(x, z, 0, "desk", desk)
                    turned = math.pi + r.normal() * 0.1
                    self.stand(x + r.uniform(-0.1, 0.1), z + desk.size[2] + 0.45, turned, "chair", chair, gap=-0.25)
        wall = self.room.walls[0]
        w = min(r.uniform(2, 4), wall.length - 0.4)
        u, board = (wall.length - w) / 2, self.s.material(linear(color(r, "thing") * 255))
        self.s.of_class("picture")
        self.s.new_thing()
        self.s.box((u, 0.85, 0.0), (u + w, 2.0, 0.03), board, wall.frame)

    def _on_top(self, frame: Array, w: float, h: float, d: float) -> None:
        r = self.r
        q = frame @ np.array([r.uniform(-0.4, 0.4) * w, h + 0.001, r.uniform(0.1, 0.7) * d, 1])
        self._clutter(standing(q[0], q[1], q[2], r.uniform(0, 6.28)))

    def _on_floor(self) -> None:
        x, z = self.r.uniform(0.3, self.room.size[0] - 0.3), self.r.uniform(0.3, self.room.size[1] - 0.3)
        if self.room.is_free(x - 0.2, z - 0.2, x + 0.2, z + 0.2, 0):
            self._clutter(standing(x, 0.001, z, self.r.uniform(0, 6.28)))

    def _clutter(self, frame: Array) -> None:
        r = self.r
        if r.random() < 0.6 and self.small:
            self.put(self.small[r.integers(len(self.small))], frame)
            return
        size = r.uniform(0.08, 0.35), r.uniform(0.03, 0.35), r.uniform(0.08, 0.3)
        self.put("thing", frame, Style(size, self.books[r.integers(len(self.books))], 0, 0, self.books))

    def _on_wall(self, wall: Wall) -> None:
        r, high = self.r, self.room.size[2]
        w, h = r.uniform(0.2, 1.3), r.uniform(0.2, 0.9)
        u, v = r.uniform(0.1, max(0.2, wall.length - w - 0.1)), r.uniform(1.0, max(1.05, high - h - 0.3))
        if any(o.left < u + w + 0.1 and o.right > u - 0.1 for o in wall.openings) or u + w > wall.length:
            return
        dice, frame = r.random(), wall.frame
        self.s.new_thing()
        if dice < 0.65:
            t, rim = r.uniform(0.01, 0.04), r.uniform(0, 0.05)
            self.s.of_class("picture")
            self.s.box((u, v, 0), (u + w, v + h, t), thing_material(self.s, r), frame)
            corner = frame @ np.array([u + rim, v + rim, t + 0.002, 1])
            shown = self.s.material((1, 1, 1), picture(r, self.room.catalogue.textures), gloss=r.choice([0, 0, 0.08]))
            a, b = wall.along * (w - 2 * rim), UP * (h - 2 * rim)
            self.s.quad(corner[:3], a, b, shown, [(0, 1), (1, 1), (1, 0), (0, 0)])
        elif dice < 0.8 or not self.hung:
            self.s.of_class("storage")
            self.s.box((u, v, 0), (u + w, v + 0.03, r.uniform(0.15, 0.3)), thing_material(self.s, r), frame)
        else:
            piece = self.hung[r.integers(len(self.hung))]
            c = frame @ np.array([u + w / 2, piece.elevation, 0.01, 1])
            self.put(piece, standing(c[0], c[1], c[2], math.atan2(wall.inward[0], wall.inward[2])))

    def _rug(self) -> None:
        r, (wide, deep, _) = self.r, self.room.size
        w, d = r.uniform(1, 2.5), r.uniform(0.8, 2)
        x, z = r.uniform(0.3, max(0.4, wide - w - 0.3)), r.uniform(0.3, max(0.4, deep - d - 0.3))
        image, span = (carpet, paper)[r.integers(2)](r, color(r, "thing"))
        if r.random() < 0.4:
            image, span = picture(r, self.room.catalogue.textures), 2.0
        self.s.of_class("floor")
        self.s.new_thing()
        self.s.box((x, 0, z), (x + w, 0.012, z + d), self.s.material((1, 1, 1), image, span))
