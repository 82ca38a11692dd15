"""The walls of a mesh that stands upright, planes that reach over much of the room's height, as an SVG from above."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ..run.folder import RunFolder
from ..run.target import Target
from ..scene.world import FIRST, WORLD, World
from ..types import Array
from .scene import ExportScene, mesh_of_run
from .walls import Wall, find_walls

FLOOR_PLAN = "floorplan.svg"
_WIDTH, _MARGIN, _FOOT = 900, 60, 86
_SIGNS = "≥: an end of this wall was not seen. ≈: it meets the next one at a flat angle, so its length is uncertain."
_STYLE = (
    "text{font:14px system-ui,sans-serif;fill:#111;text-anchor:middle}.n{text-anchor:start;fill:#555;font-size:12px}"
    ".w{stroke:#111;stroke-width:5;stroke-linecap:round}.o{stroke:#111;stroke-width:2;stroke-dasharray:3 4}"
    ".p{fill:none;stroke:#ea580c;stroke-width:1.5}.b{stroke:#111;stroke-width:2}"
)


def write_floor_plan(scene: ExportScene, target: Target) -> None:
    """Write floorplan.svg. Raises InputError as `walls_of_run`."""
    outcome, walls = scene.outcome, walls_of_run(scene.outcome.run, scene.world)
    spread, about = 0.0, ""
    if not outcome.metric and (metres := outcome.metres) is not None:
        spread, about = metres.relative_sd, metres.text
    unit = "m" if about or outcome.metric else "units"
    path = outcome.trajectory.centers[outcome.trajectory.is_posed]
    if scene.world.earth is None:  # north is up
        walls, path = levelled(walls, path)
    text = floor_plan(walls, path, outcome.run.place.stem, scene.metres_per_unit, unit, about, spread)
    write_text(target.path(FLOOR_PLAN), text)


def walls_of_run(run: RunFolder, world: World | None = None) -> list[Wall]:
    """Find the walls in `world`, by default that of the run's exported files.

    Raises InputError where the run has no mesh, its files do not stand upright, or none is found.
    """
    world = world or run.find(WORLD) or FIRST
    mesh = mesh_of_run(run, world)
    if world.axes != "up":
        raise InputError(
            f"{run.root}: a floor plan needs to know which way is up, and the exported files do not say so: film some "
            "floor and some upright edges, or if export.axes is first, set it to up"
        )
    if not (walls := find_walls(mesh.vertices, mesh.faces)):
        raise InputError(f"{run.root}: no wall is seen well enough for a floor plan: film walls from floor to ceiling")
    return walls


def floor_plan(
    walls: list[Wall], path: Array, title: str, per_unit: float, unit: str, about: str, spread: float = 0.0
) -> str:
    """An SVG of the walls and of the camera's path (N, 3); lengths are multiplied by `per_unit`, which has a relative
    deviation of `spread`, and called `unit`."""
    points = np.concatenate([*(wall.ends for wall in walls), path[:, :2]])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (_WIDTH - 2 * _MARGIN) / float((high - low).max())
    width, height = ((high - low) * scale + 2 * _MARGIN).tolist()

    def place(at: Array) -> Array:
        return np.asarray((at - low) * scale * (1, -1) + (_MARGIN, height - _MARGIN))

    way = " ".join(f"{x:.1f},{y:.1f}" for x, y in place(path[:, :2]))
    notes = enumerate([_SIGNS, f"{about[0].upper()}{about[1:]}." if about else "", _what_is_open(walls)])
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {max(width, 420):.0f} {height + _FOOT:.0f}">',
        f"<title>{escape(title)}: floor plan</title><style>{_STYLE}</style>",
        '<rect width="100%" height="100%" fill="#fff"/>',
        f'<polyline class="p" points="{way}"/>',
        *(_drawn(wall, place(wall.ends), per_unit, unit, spread) for wall in walls),
        _scale_bar(scale / per_unit, unit, height),
        *(f'<text class="n" x="{_MARGIN}" y="{height + 36 + 16 * k:.0f}">{escape(n)}</text>' for k, n in notes),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def levelled(walls: list[Wall], path: Array) -> tuple[list[Wall], Array]:
    """Turn walls and path (N, 2 or 3) by 45 degrees at most, until the longest wall lies along an edge of the paper."""
    x, y = max(walls, key=lambda wall: wall.length).along
    angle = (np.arctan2(y, x) + np.pi / 4) % (np.pi / 2) - np.pi / 4
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return [replace(wall, ends=wall.ends @ turn) for wall in walls], path[:, :2] @ turn


def _what_is_open(walls: list[Wall]) -> str:
    """What to film where the walls do not close a room; nothing where they do."""
    loose = sum(not corner for wall in walls for corner in wall.corners)
    if not loose:
        return ""
    seen = "1 wall was found" if len(walls) == 1 else f"{len(walls)} walls were found"
    return f"{seen}; {loose} of their ends meet no other wall. Film the corners and the walls from floor to ceiling."


def _drawn(wall: Wall, ends: Array, per_unit: float, unit: str, spread: float) -> str:
    """A line, a stroke across each end that is no corner, and outside the room the length, rounded to its deviation."""
    (x1, y1), (x2, y2) = ends
    outside = np.array([-wall.normal[0], wall.normal[1]])
    parts = [f'<line class="w" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>']
    for (x, y), corner in zip(ends, wall.corners, strict=True):
        if not corner:
            (ax, ay), (bx, by) = (x, y) + 12 * outside, (x, y) - 12 * outside
            parts.append(f'<line class="o" x1="{ax:.1f}" y1="{ay:.1f}" x2="{bx:.1f}" y2="{by:.1f}"/>')
    turn = float(np.degrees(np.arctan2(y2 - y1, x2 - x1)))
    turn = turn - 180 if turn > 90 else turn + 180 if turn < -90 else turn
    x, y = ends.mean(axis=0) + 16 * outside
    length = wall.length * per_unit
    digits = int(np.clip(np.ceil(-np.log10(max(spread * length, 0.01))), 0, 2))
    text = f"{wall.sign}{length:.{digits}f} {unit}"
    parts.append(f'<text transform="translate({x:.1f} {y:.1f}) rotate({turn:.1f})" dy="5">{text}</text>')
    return "".join(parts)


def _scale_bar(pixels: float, unit: str, top: float) -> str:
    """One unit, or as many as make a bar of some length; `pixels` a unit."""
    most = 200 / pixels
    ten = 10.0 ** np.floor(np.log10(most))
    value = ten * max(n for n in (1, 2, 5) if n * ten <= most)
    end = _MARGIN + value * pixels
    return (
        f'<line class="b" x1="{_MARGIN}" y1="{top:.0f}" x2="{end:.1f}" y2="{top:.0f}"/>'
        f'<text class="n" x="{_MARGIN}" y="{top + 18:.0f}">{value:g} {unit}</text>'
    )
