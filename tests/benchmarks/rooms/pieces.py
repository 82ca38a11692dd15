"""Furniture made of boxes: what stands in every room, in sizes and materials by chance."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .surfaces import Array, Surfaces
from .textures import Random

SIZES = {
    "cupboard": ((0.5, 3), (0.6, 2.3), (0.35, 0.65)), "shelf": ((0.5, 2), (0.7, 2.2), (0.22, 0.4)),
    "table": ((0.7, 2), (0.4, 0.78), (0.6, 1)), "desk": ((1, 1.7), (0.7, 0.78), (0.55, 0.8)),
    "chair": ((0.4, 0.5), (0.8, 1.05), (0.4, 0.5)), "bed": ((0.9, 1.8), (0.7, 1.2), (1.9, 2.1)),
    "sofa": ((1, 2.6), (0.7, 0.95), (0.8, 1)), "radiator": ((0.6, 1.6), (0.5, 0.9), (0.1, 0.16)),
    "rail": ((1, 2.5), (0.9, 1.1), (0.06, 0.06)), "curtain": ((0.5, 1.5), (2, 2.4), (0.1, 0.1)),
    "box": ((0.2, 0.9), (0.15, 1.0), (0.2, 0.9)), "lamp": ((0.25, 0.45), (1.2, 1.7), (0.25, 0.45)),
    "bath": ((1.5, 1.8), (0.5, 0.65), (0.7, 0.85)), "toilet": ((0.36, 0.42), (0.7, 0.85), (0.55, 0.7)),
    "sink": ((0.45, 0.9), (0.8, 0.9), (0.4, 0.52)), "shower": ((0.75, 1.1), (1.9, 2.1), (0.75, 1.0)),
    "bidet": ((0.35, 0.4), (0.4, 0.42), (0.5, 0.6)), "hob": ((0.5, 0.6), (0.02, 0.03), (0.45, 0.5)),
}  # fmt: skip
"""Least and most width, height and depth, metres."""


@dataclass(frozen=True)
class Style:
    """Size (3,) of a piece, its three materials, and those of books and cushions."""

    size: tuple[float, float, float]
    first: int
    second: int
    third: int
    books: list[int]


class _Builder:
    """Boxes in the piece's frame: x along its width from its left, y up, z forward from its back."""

    def __init__(self, surfaces: Surfaces, frame: Array, style: Style) -> None:
        self.surfaces, self.frame, self.style = surfaces, frame, style

    def __call__(self, x: float, y: float, z: float, to_x: float, to_y: float, to_z: float, material: int) -> None:
        half = self.style.size[0] / 2
        self.surfaces.box((x - half, y, z), (to_x - half, to_y, to_z), material, self.frame)


def build_piece(surfaces: Surfaces, kind: str, style: Style, frame: Array, r: Random) -> None:
    """Add a piece whose back stands at the frame's origin."""
    box = _Builder(surfaces, frame, style)
    surfaces.of_class(_CLASS_OF.get(kind, "thing"))
    if kind in _KINDS:
        _KINDS[kind](box, style, r)
    else:
        box(0, 0, 0, *style.size, style.first)


def _cupboard(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    box(0, 0, 0, w, h, d, style.first)
    columns, rows = max(1, round(w / r.uniform(0.4, 0.6))), int(r.choice([1, 1, 2, 3]))
    gap, proud = 0.004, r.uniform(0.0, 0.02)
    for i in range(columns):
        for j in range(rows):
            left, right = i * w / columns + gap, (i + 1) * w / columns - gap
            low, high = j * h / rows + gap + 0.05 * (j == 0), (j + 1) * h / rows - gap
            box(left, low, d, right, high, d + 0.005 + proud, style.second)
            if r.random() < 0.8:
                x, y = right - 0.05 if i % 2 == 0 else left + 0.03, (low + high) / 2
                box(x, y - 0.05, d, x + 0.015, y + 0.05, d + 0.03 + proud, style.third)


def _shelf(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), t = style.size, 0.02
    box(0, 0, 0, t, h, d, style.first)
    box(w - t, 0, 0, w, h, d, style.first)
    boards = max(2, int(h / r.uniform(0.3, 0.45)))
    if r.random() < 0.7:
        box(0, 0, 0, w, h, 0.01, style.first)
    for j in range(boards + 1):
        y, x = j * (h - t) / boards, t + 0.01
        box(0, y, 0, w, y + t, d, style.first)
        while j < boards and x < w - 0.1 and r.random() < 0.93:
            if r.random() < 0.25:
                x += r.uniform(0.05, 0.4)
                continue
            thick, high = r.uniform(0.015, 0.06), r.uniform(0.5, 0.9) * (h / boards - t)
            if x + thick > w - t:
                break
            book = style.books[r.integers(len(style.books))]
            box(x, y + t, 0.01, x + thick, y + t + high, r.uniform(0.5, 0.95) * d, book)
            x += thick + 0.001


def _table(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    top, leg, inset = r.uniform(0.02, 0.05), r.uniform(0.02, 0.07), r.uniform(0, 0.08)
    box(0, h - top, 0, w, h, d, style.first)
    for x in (inset, w - leg - inset):
        for z in (inset, d - leg - inset):
            box(x, 0, z, x + leg, h - top, z + leg, style.second)
    if r.random() < 0.4:
        box(inset, h - top - 0.1, inset, w - inset, h - top, d - inset, style.second)


def _desk(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    _table(box, style, r)
    if r.random() < 0.5:
        box(0.03, 0.25, 0.03, w - 0.03, h - 0.03, 0.05, style.first)
    if r.random() < 0.4:
        box(w - 0.45, 0.05, 0.05, w - 0.03, h - 0.03, d - 0.05, style.first)


def _chair(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), leg, seat = style.size, r.uniform(0.015, 0.04), 0.45
    box(0, seat - 0.03, 0, w, seat, d, style.first)
    for x in (0, w - leg):
        box(x, 0, 0, x + leg, h, leg, style.second)
        box(x, 0, d - leg, x + leg, seat, d, style.second)
    if r.random() < 0.5:
        box(leg, seat + 0.15, 0, w - leg, h, 0.02, style.first)
        return
    for k in range(4):
        x = leg + (k + 0.5) * (w - 2 * leg) / 4
        box(x - 0.012, seat, 0, x + 0.012, h, 0.02, style.second)


def _bed(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    box(0, 0, 0, w, 0.3, d, style.second)
    box(0.02, 0.3, 0.02, w - 0.02, h * 0.6, d - 0.02, style.first)
    box(0, 0, 0, w, h, 0.05, style.second)
    for k in range(2):
        x = 0.1 + k * w / 2
        box(x, h * 0.6, 0.1, x + w / 2 - 0.2, h * 0.6 + 0.12, 0.5, style.third)


def _sofa(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), seat, arm = style.size, 0.42, r.uniform(0.12, 0.25)
    box(0, 0.06, 0, w, seat - 0.12, d, style.first)
    box(0, 0.06, 0, w, h, 0.22, style.first)
    for x in (0, w - arm):
        box(x, 0.06, 0, x + arm, seat + 0.2, d, style.first)
    cushions = max(1, int(w / 0.7))
    for k in range(cushions):
        x, wide = arm + k * (w - 2 * arm) / cushions, (w - 2 * arm) / cushions
        box(x + 0.005, seat - 0.12, 0.2, x + wide - 0.005, seat + 0.03, d + 0.01, style.first)
        box(x + 0.01, seat + 0.03, 0.2, x + wide - 0.01, h - 0.03, 0.34, style.first)
    for _ in range(int(r.integers(0, 3))):
        x = r.uniform(arm, w - arm - 0.4)
        box(x, seat + 0.03, 0.34, x + 0.4, seat + 0.4, 0.44, style.books[r.integers(len(style.books))])


def _radiator(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), count = style.size, int(style.size[0] / 0.06)
    for k in range(count):
        box(k * w / count, 0.1, 0.03, k * w / count + 0.04, h, d, style.first)
    box(0, 0.12, 0.05, w, 0.16, d - 0.02, style.first)
    box(0, h - 0.06, 0.05, w, h - 0.02, d - 0.02, style.first)


def _rail(box: _Builder, style: Style, r: Random) -> None:
    w, h, _ = style.size
    count, bar = int(w / r.uniform(0.09, 0.14)), r.uniform(0.012, 0.03)
    box(0, h - 0.05, 0, w, h, 0.06, style.first)
    box(0, 0.05, 0, w, 0.09, 0.06, style.first)
    for k in range(count + 1):
        x = k * (w - bar) / count
        box(x, 0.05, 0.03 - bar / 2, x + bar, h - 0.05, 0.03 + bar / 2, style.second)


def _curtain(box: _Builder, style: Style, r: Random) -> None:
    w, h, _ = style.size
    count = int(w / 0.12)
    for k in range(count):
        z = 0.03 + 0.03 * (k % 2)
        box(k * w / count, 0.03, z, (k + 1) * w / count, h, z + 0.03, style.first)


def _lamp(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    x, z, rod, shade = w / 2, d / 2, r.uniform(0.008, 0.02), r.uniform(0.2, 0.35)
    box(x - 0.12, 0, z - 0.12, x + 0.12, 0.02, z + 0.12, style.third)
    box(x - rod, 0, z - rod, x + rod, h, z + rod, style.third)
    glow = np.array([1.0, 0.85, 0.6]) * r.uniform(0.5, 3)
    box(0, h - shade, 0, w, h, d, box.surfaces.material((0.8, 0.75, 0.65), emission=glow))


def _cooker(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), pane = style.size, r.uniform(0.5, 0.75)
    box(0, 0, 0, w, h, d - 0.02, style.first)
    box(0.005, 0.08, 0, w - 0.005, h - 0.005, d, style.second)
    box(0.06, 0.15, d, w - 0.06, pane * h, d + 0.004, style.third)
    box(0.08, (pane + 0.05) * h, d, w - 0.08, (pane + 0.05) * h + 0.02, d + 0.04, style.third)


def _fridge(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), cut = style.size, r.uniform(0.3, 0.7) * style.size[1]
    box(0, 0, 0, w, h, d - 0.05, style.third)
    for low, high in ((0.05, cut), (cut + 0.01, h)):
        box(0, low, d - 0.05, w, high, d, style.third)
        box(0.04, low + 0.1, d, 0.07, min(low + 0.5, high - 0.05), d + 0.03, style.second)


def _basin(box: _Builder, style: Style, r: Random) -> None:
    """A sink let into what is under the frame's foot, with its tap."""
    w, d, t = style.size[0], style.size[2] * 0.9, 0.02
    for a, b, c, e in ((0, 0, w, t), (0, d - t, w, d), (0, 0, t, d), (w - t, 0, w, d)):
        box(a, -0.01, b, c, r.uniform(0.004, 0.015), e, style.third)
    box(t, -0.01, t, w - t, 0.002, d - t, style.third)
    box(w / 2 - 0.012, 0, -0.04, w / 2 + 0.012, 0.2, -0.016, style.third)
    box(w / 2 - 0.012, 0.18, -0.04, w / 2 + 0.012, 0.2, 0.12, style.third)


def _sink(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), bowl = style.size, r.uniform(0.12, 0.2)
    for a, b, c, e in ((0, 0, w, 0.06), (0, d - 0.04, w, d), (0, 0, 0.04, d), (w - 0.04, 0, w, d)):
        box(a, h - bowl, b, c, h, e, style.third)
    box(0, h - bowl, 0, w, h - bowl + 0.03, d, style.third)
    box(w / 2 - 0.012, h, 0.02, w / 2 + 0.012, h + 0.15, 0.04, style.third)
    box(w / 2 - 0.012, h + 0.13, 0.02, w / 2 + 0.012, h + 0.15, 0.15, style.third)
    if r.random() < 0.5:
        box(w / 2 - 0.09, 0, 0.05, w / 2 + 0.09, h - bowl, 0.25, style.third)
    elif r.random() < 0.7:
        box(0.02, 0.1, 0, w - 0.02, h - bowl, d - 0.03, style.first)


def _bath(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), rim = style.size, r.uniform(0.05, 0.1)
    for a, b, c, e in ((0, 0, w, rim), (0, d - rim, w, d), (0, 0, rim, d), (w - rim, 0, w, d)):
        box(a, 0, b, c, h, e, style.third)
    box(rim, 0, rim, w - rim, r.uniform(0.1, 0.3), d - rim, style.third)


def _toilet(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), seat = style.size, 0.42
    if r.random() < 0.7:
        box(0, seat - 0.05, 0, w, h, 0.18, style.third)
    box(0.08, 0, 0.1, w - 0.08, seat - 0.12, d - 0.12, style.third)
    box(0.02, seat - 0.15, 0.12, w - 0.02, seat - 0.02, d, style.third)
    box(0.01, seat - 0.02, 0.17, w - 0.01, seat, d + 0.01, style.third)
    if r.random() < 0.4:
        box(0.02, seat, 0.19, w - 0.02, seat + d * 0.7, 0.22, style.third)


def _shower(box: _Builder, style: Style, r: Random) -> None:
    (w, h, d), t = style.size, 0.03
    box(0, 0, 0, w, r.uniform(0.03, 0.15), d, style.third)
    for x in (0.0, w - t):
        box(x, 0, d - t, x + t, h, d, style.second)
    if r.random() < 0.6:
        box(r.choice([0, w - 0.01]), 0.1, 0, w, h, d, style.second) if r.random() < 0.3 else None
        box(0, h - t, d - t, w, h, d, style.second)
    box(w / 2 - 0.015, 0.9, 0.02, w / 2 + 0.015, h, 0.05, style.second)
    box(w / 2 - 0.1, h - 0.05, 0.02, w / 2 + 0.1, h - 0.02, 0.22, style.second)


def _hood(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    box(0, 0.2, 0, w, 0.3, d + 0.1, style.third)
    box(w / 2 - 0.15, 0.3, 0, w / 2 + 0.15, h, 0.25, style.third)


def _hob(box: _Builder, style: Style, r: Random) -> None:
    w, h, d = style.size
    box(0, 0, 0, w, h * 0.3, d, style.second)
    for x in (0.1, w - 0.26):
        for z in (0.06, d - 0.22):
            box(x, 0, z, x + 0.16, h, z + 0.16, style.third)


_KINDS: dict[str, Callable[[_Builder, Style, Random], None]] = {
    "cupboard": _cupboard, "shelf": _shelf, "table": _table, "desk": _desk, "chair": _chair, "bed": _bed,
    "sofa": _sofa, "radiator": _radiator, "rail": _rail, "curtain": _curtain, "lamp": _lamp,
    "cooker": _cooker, "fridge": _fridge, "basin": _basin, "sink": _sink, "bath": _bath, "toilet": _toilet,
    "bidet": _toilet, "shower": _shower, "hood": _hood, "hob": _hob,
}  # fmt: skip
_CLASS_OF = {
    "cupboard": "storage", "shelf": "storage", "box": "storage", "table": "table", "desk": "table", "bed": "bed",
    "chair": "seating", "sofa": "seating", "radiator": "appliance", "curtain": "curtain", "lamp": "lamp",
    **dict.fromkeys(
        ("cooker", "fridge", "basin", "sink", "bath", "toilet", "bidet", "shower", "hood", "hob"), "appliance"
    ),
}  # fmt: skip
