"""What stands in kitchens and bathrooms: rows along the walls, things at the taps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .pieces import Style
from .surfaces import Array, Wall, standing
from .textures import linear

if TYPE_CHECKING:
    from .room import Furnisher

WET = {"kitchen": ((2.2, 4.6), (2.6, 5.2)), "bathroom": ((1.8, 3.2), (2.2, 4.0))}
"""Least and most metres of the floor."""
_AT_WALL = 0.02


def furnish_wet(f: Furnisher) -> None:
    """Everything that a kitchen or bathroom has of its own, before what any room has."""
    walls = [f.room.walls[i] for i in f.r.permutation(4)]
    if f.room.kind == "kitchen":
        for wall in walls[: int(f.r.integers(1, 4))]:
            _row(f, wall)
        return
    for kind in ("bath", "toilet", "sink", "shower", "sink", "bidet", "cupboard"):
        if f.r.random() < {"bath": 0.7, "bidet": 0.2, "toilet": 0.9, "shower": 0.5}.get(kind, 0.7):
            next((w for w in walls[int(f.r.integers(0, 2)) :] if _fixture(f, w, kind)), None)


def _row(f: Furnisher, wall: Wall) -> None:
    """Cupboards with fronts under one worktop, sink, cooker, machines, a fridge, and cupboards above."""
    r, u, deep, high = f.r, f.r.uniform(0.02, 0.6), f.r.uniform(0.55, 0.65), f.r.uniform(0.82, 0.95)
    front, top = f.style("cupboard"), f.style("cupboard").first
    upper = r.random() < 0.75
    end = wall.length - (0.02 if r.random() < 0.5 else r.uniform(0.3, 1.0))
    while u < end - 0.4:
        width = min(r.uniform(0.4, 0.9), end - u)
        here = [o for o in wall.openings if o.left < u + width and o.right > u]
        kind = str(r.choice(["cupboard", "sink", "cooker", "machine", "fridge"], p=[0.5, 0.15, 0.13, 0.12, 0.1]))
        tall = r.uniform(1.3, 2.1) if kind == "fridge" else high
        frame = _at(f, wall, u, width, tall, deep)
        if frame is not None:
            size = width, tall if kind == "fridge" else high - 0.035, deep
            style = Style(size, front.first, front.second, front.third, f.books)
            what = {"sink": "cupboard", "machine": "cooker"}.get(kind, kind)
            f.put(what, frame, style)
            if kind != "fridge":
                f.s.of_class("storage")
                f.s.box((-width / 2, high - 0.03, 0), (width / 2, high, deep + 0.02), top, frame)
                f.room.tops.append((frame, width, high, deep))
            if kind in ("sink", "cooker"):
                style = f.style("sink" if kind == "sink" else "hob")
                style = replace(style, size=(min(style.size[0], width - 0.08), *style.size[1:]))
                f.put("basin" if kind == "sink" else "hob", frame @ _moved(high, 0.08), style)
            above = r.uniform(1.3, 1.5)
            if upper and kind != "fridge" and above + 0.4 < f.room.size[2] and not any(o.low < 2.1 for o in here):
                size = width, min(r.uniform(0.5, 0.8), f.room.size[2] - above), r.uniform(0.28, 0.38)
                style = Style(size, front.first, front.second, front.third, f.books)
                f.put("hood" if kind == "cooker" else "cupboard", frame @ _moved(above, 0), style)
        u += width if frame is not None else 0.2


def _fixture(f: Furnisher, wall: Wall, kind: str) -> bool:
    """Put a fixture at a wall where there is place, sometimes one of the catalogue; a mirror above a sink."""
    r, style = f.r, f.style(kind)
    words = {"bath": "bath$|bathtub", "toilet": "toilets unit", "sink": "washbasin|lavatory", "shower": "shower stall"}
    width, high, deep = style.size
    u = r.choice([0.02, wall.length - width - 0.02, r.uniform(0, max(wall.length - width, 0.01))])
    if width > wall.length or (frame := _at(f, wall, float(u), width, high, deep)) is None:
        return False
    made = f.named(words[kind]) if kind in words and r.random() < 0.5 else []
    piece = made[int(r.integers(len(made)))] if made else None
    if piece is not None and piece.size[0] <= width + 0.2 and piece.size[2] <= deep + 0.2:
        f.put(piece, frame @ _moved(piece.elevation, 0))
    else:
        f.put(kind, frame, style)
    if kind == "sink" and r.random() < 0.8:
        f.s.new_thing()
        f.s.of_class("picture")
        half, low = r.uniform(0.2, 0.5), r.uniform(1.1, 1.35)
        f.s.box(
            (-half, low, 0), (half, low + r.uniform(0.4, 0.8), 0.02), f.s.material(linear(np.full(3, 170.0))), frame
        )
    return True


def _at(f: Furnisher, wall: Wall, u: float, width: float, high: float, deep: float) -> Array | None:
    """The frame of the middle of a thing's back at a wall, its floor taken; None where there is no place."""
    if any(o.left < u + width and o.right > u and o.low < high for o in wall.openings):
        return None
    low, far = (wall.origin + wall.along * x + wall.inward * z for x, z in ((u, 0.0), (u + width, deep)))
    x0, x1, z0, z1 = *sorted((low[0], far[0])), *sorted((low[2], far[2]))
    if not f.room.is_free(x0, z0, x1, z1, -0.02):
        return None
    f.room.taken.append((x0, z0, x1, z1))
    p = wall.origin + wall.along * (u + width / 2) + wall.inward * _AT_WALL
    return standing(p[0], 0, p[2], math.atan2(wall.inward[0], wall.inward[2]))


def _moved(up: float, forward: float) -> Array:
    out = np.eye(4)
    out[1, 3], out[2, 3] = up, forward
    return out
