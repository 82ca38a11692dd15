"""The walls of a mesh that stands upright: planes that reach over much of the room's height."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, pairwise, permutations

import numpy as np
from numpy.typing import NDArray

from ..types import Array

_LEANS = np.sin(np.radians(15))
"""A wall's normal rises less."""
_APART, _OF_DIRECTION = np.radians(8), np.radians(12)
"""Directions differ by more; a face's normal differs from its wall's by less."""
_SAME_WAY, _BESIDE = np.cos(np.radians(30)), 0.08
"""Walls that look within 30 degrees, and lie so near in heights of the room, may be one."""
_SQUARE = np.radians(3)
"""Directions that are so nearly at right angles are."""
_STEPS = 60
"""Of the room's height: a wall is one thick, twice that where pictures hang on it."""
_ROUGH = 0.03
"""Lengths that are less certain are approximate."""
_LAYERS, _MIN_LAYERS = 20, 8
"""Of the room's height: a column of a wall shows so many."""
_FITS = 8
_MIN_SHARE, _MIN_AREA = 0.08, 0.045
"""A direction's area, of that of the strongest; a plane's, in squared heights of the room."""
_BETWEEN, _COVERED = 0.5, 0.9
"""In heights of the room: the longest wall that is looked for between two ends; and how much of it has to be seen."""
_SMALL_GAP, _GAP, _MIN_LENGTH, _CORNER, _IN_FRONT = 0.1, 0.7, 0.3, 0.4, 0.35
"""In heights of the room: openings and furniture that a wall goes on behind, shorter is no wall, ends that meet, and
how far a cupboard stands before the wall that it hides."""


@dataclass(frozen=True)
class Wall:
    """ends (2, 2) on the floor; the side that is seen lies to the left of the way from the first to the second.
    corners: which ends are where another wall meets; the others are where no more was seen. blur: how far the corners
    may lie from there along the wall, both together."""

    ends: Array
    corners: tuple[bool, bool] = (False, False)
    blur: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether both ends are corners, so that its length is that of the wall."""
        return all(self.corners)

    @property
    def sign(self) -> str:
        """Sign before its length: ≥ where an end was not seen, ≈ where it meets its neighbours at flat angles,
        as the sides of a bay do, so that its ends are uncertain."""
        return "≥ " if not self.is_whole else "≈ " if self.blur > _ROUGH * self.length else ""

    @property
    def length(self) -> float:
        """Distance between the ends."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    @property
    def along(self) -> Array:
        """(2,) unit vector from the first to the second."""
        return np.asarray((self.ends[1] - self.ends[0]) / max(self.length, 1e-12))

    @property
    def normal(self) -> Array:
        """(2,) unit vector into the room."""
        return np.array([-self.along[1], self.along[0]])


@dataclass(frozen=True)
class _Faces:
    """Upright faces: centers (F, 3), area (F,), angle (F,) of the normal; the room's lowest z, and height."""

    centers: Array
    area: Array
    angle: Array
    low: float
    height: float

    def only(self, rows: NDArray[np.bool_]) -> _Faces:
        return _Faces(self.centers[rows], self.area[rows], self.angle[rows], self.low, self.height)

    def facing(self, angle: float) -> NDArray[np.bool_]:
        """Which of them have about this angle."""
        return np.asarray(np.abs((self.angle - angle + np.pi) % (2 * np.pi) - np.pi) < _OF_DIRECTION)

    def next_to(self, line: _Line) -> tuple[_Faces, _Faces]:
        """Those on a line, and those that are neither on it nor near it and look another way."""
        mine = self.facing(line.angle)
        far = np.abs((self.centers[:, :2] - line.place) @ (-line.along[1], line.along[0])) / self.height * _STEPS
        return self.only(mine & (far < 2)), self.only(~mine | (far >= 3))


@dataclass(frozen=True)
class _Line:
    """Through place (2,) along (2,), with the room to its left; the area on it, the angle it was sought at."""

    area: float
    angle: float
    place: Array
    along: Array


def find_walls(vertices: NDArray, faces: NDArray) -> list[Wall]:
    """Find the walls of a mesh (V, 3), (F, 3) with z up whose faces look into the room, longest first; corners meet."""
    upright = _upright_faces(vertices, faces)
    if len(upright.area) == 0 or upright.height <= 0:
        return []
    angles = [angle + turn for angle in _directions(upright) for turn in (0.0, np.pi)]
    walls: list[Wall] = []
    left = upright
    while (found := max((_strongest_line(left, angle) for angle in angles), key=lambda line: line.area)).area > 0:
        here, left = left.next_to(found)
        walls += [Wall(found.place + np.array([[a], [b]]) * found.along) for a, b in _stretches(here, found)]
    walls = _without_cupboards(_without_doubles(walls, upright.height), upright.height)
    walls = _without_doubles(walls + _between_ends(walls, upright), upright.height)
    return _without_doubles(_meeting(walls, upright.height), upright.height)


def _upright_faces(vertices: NDArray, faces: NDArray) -> _Faces:
    corners = vertices.astype(np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(cross, axis=1)
    centers = corners.mean(axis=1)
    low, high = np.quantile(centers[:, 2], (0.01, 0.99)) if len(centers) else (0.0, 1.0)
    rows, angle = (twice > 0) & (np.abs(cross[:, 2]) < _LEANS * twice), np.arctan2(cross[:, 1], cross[:, 0])
    return _Faces(centers, twice / 2, angle, float(low), float(high - low)).only(rows)


def _directions(faces: _Faces) -> list[float]:
    """Angles modulo half a turn that many faces look along; those nearly square to the first are made so."""
    half, left = faces.angle % np.pi, np.ones(len(faces.area), bool)
    found: list[float] = []
    first = 0.0
    while left.any():
        weight = np.bincount((np.degrees(half[left])).astype(int) % 180, faces.area[left], minlength=180)
        smooth = sum(np.roll(weight, k) for k in (-2, -1, 0, 1, 2))
        peak = np.radians(int(np.argmax(smooth)) + 0.5)
        near = left & (np.abs(_between(half, peak)) < _APART)
        strength = float(faces.area[near].sum())
        first = first or strength
        if strength < _MIN_SHARE * first:
            break
        angle = peak + float(np.average(_between(half[near], peak), weights=faces.area[near]))
        if found and abs(_between(angle, found[0] + np.pi / 2)) < _SQUARE:
            angle = found[0] + np.pi / 2
        found.append(float(angle))
        left &= np.abs(_between(half, peak)) >= _APART
    return found


def _between(angle: Array | float, other: float) -> Array:
    """From the other to the angle, modulo half a turn."""
    return np.asarray((np.asarray(angle) - other + np.pi / 2) % np.pi - np.pi / 2)


def _strongest_line(faces: _Faces, angle: float) -> _Line:
    """The line that most area with about this angle lies on, as its own faces lie; of no area for too little."""
    step, normal = faces.height / _STEPS, np.array([np.cos(angle), np.sin(angle)])
    faces = faces.only(faces.facing(angle))
    if float(faces.area.sum()) < (least := _MIN_AREA * faces.height**2):
        return _Line(0.0, angle, np.zeros(2), normal)
    across = faces.centers[:, :2] @ normal
    cell = np.floor((across - across.min()) / step).astype(int)
    weight = np.convolve(np.bincount(cell, faces.area), np.ones(5), "same")
    near = np.abs(across - across.min() - (np.argmax(weight) + 0.5) * step) < 2.5 * step
    for _ in range(_FITS):
        place = np.average(faces.centers[near, :2], axis=0, weights=faces.area[near])
        away = (faces.centers[near, :2] - place) * np.sqrt(faces.area[near])[:, None]
        along = np.linalg.eigh(away.T @ away)[1][:, 1]
        along = _not_across(along, np.array([normal[1], -normal[0]]))
        off = (faces.centers[:, :2] - place) @ (-along[1], along[0])
        if not (here := np.abs(off) < 2 * step).any():  # between a wall and what stands before it: on with the larger
            before, all_of = near & (off > 0), float(faces.area[near].sum())
            here = before if faces.area[before].sum() > all_of / 2 else near & (off <= 0)
        near = here
    area = float(faces.area[np.abs(off) < 2 * step].sum())
    return _Line(area if area > least else 0.0, angle, place, along)


def _not_across(along: Array, expected: Array) -> Array:
    """The fitted direction, the way of the expected one; the expected one where it leans too far from it, as the line
    through two walls that stand one behind the other does."""
    along = along * np.sign(along @ expected or 1.0)
    return along if along @ expected > np.cos(_APART) else expected


def _full_columns(faces: _Faces, t: Array) -> NDArray[np.int64]:
    """Columns, two steps wide along `t` (F,) from its least, that reach over enough of the room's height."""
    layer = np.clip((faces.centers[:, 2] - faces.low) / faces.height * _LAYERS, 0, _LAYERS - 1)
    column = np.floor((t - t.min()) / (2 * faces.height / _STEPS)).astype(int)
    shown = np.zeros((column.max() + 1, _LAYERS), bool)
    shown[column, layer.astype(int)] = True
    return np.flatnonzero(shown.sum(axis=1) >= _MIN_LAYERS)


def _between_ends(walls: list[Wall], faces: _Faces) -> list[Wall]:
    """Short walls from the end of one to the beginning of another, where a surface stands on most of the way: they are
    what cuts off the corner that the two would have."""
    found = []
    step = faces.height / _STEPS
    for first, second in permutations(walls, 2):
        wall = Wall(np.stack([first.ends[1], second.ends[0]]))
        if not 3 * step < wall.length < _BETWEEN * faces.height or _touch(first, second, step):
            continue
        away, directions = faces.centers[:, :2] - wall.ends[0], np.stack([np.cos(faces.angle), np.sin(faces.angle)], 1)
        t = away @ wall.along
        here = (np.abs(away @ wall.normal) < 2 * step) & (t >= 0) & (t <= wall.length)
        here &= directions @ wall.normal > _SAME_WAY
        if here.any() and len(_full_columns(faces.only(here), t[here])) * 2 * step > _COVERED * wall.length:
            found.append(wall)
    return found


def _touch(first: Wall, second: Wall, step: float) -> bool:
    """Whether the end of the first and the beginning of the second reach the place where the two lines cross."""
    if abs(first.along @ second.normal) < np.sin(_APART):
        return False
    place = _crossing(first, second)
    short = (place - first.ends[1]) @ first.along, (second.ends[0] - place) @ second.along
    return bool(max(short) < 2 * step)


def _stretches(faces: _Faces, line: _Line) -> list[tuple[float, float]]:
    """Where along a plane its columns reach over enough of the room's height; gaps are closed."""
    step, t = faces.height / _STEPS, (faces.centers[:, :2] - line.place) @ line.along
    full = _full_columns(faces, t)
    if len(full) == 0:
        return []
    cuts = np.flatnonzero(np.diff(full) * 2 * step > _SMALL_GAP * faces.height)
    starts, ends = full[np.append(0, cuts + 1)], full[np.append(cuts, len(full) - 1)] + 1
    found = [(t.min() + 2 * step * a, t.min() + 2 * step * b) for a, b in zip(starts, ends, strict=True)]
    found = _over_gaps(found, _GAP * faces.height)
    return [(a, b) for a, b in found if b - a > _MIN_LENGTH * faces.height]


def _over_gaps(pieces: list[tuple[float, float]], most: float) -> list[tuple[float, float]]:
    """Neighbours joined, the closest first, where the gap is shorter than `most` and than each of the two."""
    pieces = list(pieces)
    while gaps := [
        (b[0] - a[1], k)
        for k, (a, b) in enumerate(pairwise(pieces))
        if b[0] - a[1] < min(most, a[1] - a[0], b[1] - b[0])
    ]:
        _, k = min(gaps)
        pieces[k : k + 2] = [(pieces[k][0], pieces[k + 1][1])]
    return pieces


def _without_doubles(walls: list[Wall], height: float) -> list[Wall]:
    """Those of which not most lies on one as long or longer that looks about the same way, longest first."""

    def on(short: Wall, long: Wall) -> bool:
        if short.normal @ long.normal < _SAME_WAY:
            return False
        away = short.ends[0] + np.linspace(0, 1, 21)[:, None] * (short.ends[1] - short.ends[0]) - long.ends[0]
        next_to = np.abs(away @ long.normal) < _BESIDE * height
        inside = (away @ long.along > -_BESIDE * height) & (away @ long.along < long.length + _BESIDE * height)
        return bool((next_to & inside).mean() > 0.5)

    kept: list[Wall] = []
    for wall in sorted(walls, key=lambda wall: -wall.length):
        if not any(on(wall, longer) for longer in kept):
            kept.append(wall)
    return kept


def _without_cupboards(walls: list[Wall], height: float) -> list[Wall]:
    """Those that do not stand close before a longer one that looks the same way."""

    def hides(front: Wall, back: Wall) -> bool:
        if front.length >= back.length or front.normal @ back.normal < np.cos(_APART):
            return False
        depth = (front.ends - back.ends[0]) @ back.normal
        t = (front.ends - back.ends[0]) @ back.along
        reach = _CORNER * height
        close = (depth > 0).all() and (depth < _IN_FRONT * height).all()
        return bool(close and -reach < t.min() < t.max() < back.length + reach)

    return [wall for wall in walls if not any(hides(wall, other) for other in walls)]


def _meeting(walls: list[Wall], height: float) -> list[Wall]:
    """Ends that lie close to where two walls cross are moved there, the closest first."""
    options, step = [], height / _STEPS
    for (j, second), (i, first) in combinations(enumerate(walls), 2):
        if (sine := abs(float(first.along @ second.normal))) < np.sin(_APART):
            continue
        place = _crossing(first, second)
        (k, far), (m, too) = (_nearest_end(w, place) for w in (first, second))
        if max(far, too) < _CORNER * height and min(far, too) > -3 * step * (1 + 1 / sine):
            options.append((max(abs(far), abs(too)), (i, k), (j, m), place, step / 2 / sine))
    done: set[tuple[int, int]] = set()
    walls = list(walls)
    for _, one, other, place, blur in sorted(options, key=lambda option: option[0]):
        if {one, other} & done:
            continue
        done |= {one, other}
        for number, end in (one, other):
            ends = walls[number].ends.copy()
            ends[end] = place
            met = [end == k or walls[number].corners[k] for k in (0, 1)]
            blurred = walls[number].blur + blur
            walls[number] = replace(walls[number], ends=ends, corners=(met[0], met[1]), blur=blurred)
    return walls


def _nearest_end(wall: Wall, place: Array) -> tuple[int, float]:
    """The end nearest to a place on the wall's line, and how far the wall would have to grow to it (or shrink: < 0)."""
    beyond = float((place - wall.ends.mean(axis=0)) @ wall.along)
    return int(beyond > 0), abs(beyond) - wall.length / 2


def _crossing(first: Wall, second: Wall) -> Array:
    """(2,) where the lines of two walls that are not parallel cross."""
    sides = np.stack([first.along, -second.along], axis=1)
    t = np.linalg.solve(sides, second.ends[0] - first.ends[0])
    return np.asarray(first.ends[0] + t[0] * first.along)
