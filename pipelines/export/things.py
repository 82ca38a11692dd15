"""Things in the mesh: patches of one slope and colour, joined into what stands on the floor, hangs on a wall, or lies.

Where up is known, the floor, the ceiling and the walls are found by their planes first; classes alone call wall what is
as white as one. Patches (graph-based segmentation, Felzenszwalb and Huttenlocher, IJCV 2004) of all else are joined
where they do not meet in a hollow edge, differ little in colour, and have no two names; on a plane, what differs from
it in colour and is about rectangular is a thing too, such as a picture or a rug.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from ...formats.ply import MeshArrays, normal_sums
from ..labels.segments import cut_graph
from ..types import Array
from .surface import components
from .walls import find_walls

STRUCTURE = ("wall", "floor", "ceiling")
"""Classes that are no things."""
MIN_FACES = 200

_SMOOTH = 3
"""Rounds in which a vertex's normal and colour become the mean with those around it."""
_COLOR_UNIT, _BEND, _CONVEX, _OTHER_NAME = 12.0, 4.0, 0.3, 0.5
"""Cost of an edge in a patch: one for so much difference in CIE Lab; for a right angle, and the part of it for one that
bends outwards; for two names."""
_PATCH = 30.0
"""How readily patches form, in median vertices."""
_HOLLOW, _COLOR, _NAMES, _SHORT = 10.0, 0.03, 1.0, 0.3
"""Cost of joining two patches: their border's mean bend inwards, a unit of Lab, other names, and a border that is as
long as the root of the smaller one's area (the more the shorter it is). Chosen with `_JOIN` and those below on demo,
whiteroom_2, staircase and three made rooms."""
_JOIN, _JOIN_AREA = 0.4, 2000.0
"""How readily patches are joined, by area in squared edges of the usual length."""
LARGEST, _LESS, _CUTS = 0.6, 0.3, 3
"""Area in squared heights of the room beyond which a group is cut again, how much less readily it is joined then, and
how often."""
_NAMED = 0.6
"""A patch is no structure where this share of it has the name of something else."""
_CALLED, _MEETS = 0.5, 0.2
"""Share of a patch that is called structure, and that lies on a plane, with which together it is structure."""

_IN_WALLS, _FLUSH = ("door", "window", "windowpane", "curtain"), 0.9
"""Names that a bare wall is given too, and the share of a patch on a plane from which they make no thing of it."""

_FLOOR_THICK, _WALL_THICK, _BEHIND, _BESIDE = 0.03, 0.025, 0.05, 0.05
"""In heights of the room: how far a surface may be from its floor or ceiling and from its wall, behind that, and beyond
the wall's ends."""
_LEVEL, _ALONG, _UPRIGHT = 0.9, 0.7, 0.3
"""Cosines: to up of what a level is found by; to a plane's normal of what lies on it; to up, at most, of a wall."""
_BINS, _LEVEL_SHARE, _TALL = 200, 0.02, 0.85
"""Levels in a room; share of the surface that makes one; share of its height over which a wall reaches."""
_BACK, _ALIKE = 0.1, 6.0
"""A patch on a plane with more area (in squared heights) is the plane's own, and those beside it that differ by no more
in Lab."""
_LEAST_PANEL, _MOST_PANEL, _FILLED, _SLENDER = 0.004, 0.8, 0.65, 0.2
"""Squared heights of a picture or a rug, the share that it fills of the rectangle around it, and how narrow that is."""


@dataclass(frozen=True)
class Parts:
    """The mesh as a graph: edges (E, 2) of vertices, and of these (V,): area, normal (V, 3), Lab colour (V, 3) with
    lightness halved, patch, label with VOID as the last; `step`: median length of an edge."""

    mesh: MeshArrays
    edges: NDArray[np.int64]
    area: Array
    normal: Array
    color: Array
    patch: NDArray[np.int64]
    bend: Array
    hollow: NDArray[np.bool_]
    step: float

    @property
    def count(self) -> int:
        """Return the number of patches."""
        return int(self.patch.max(initial=-1)) + 1

    @property
    def size(self) -> Array:
        """Return (P,) areas of the patches."""
        return np.maximum(np.bincount(self.patch, self.area, self.count), 1e-12)

    def mean(self, values: Array) -> Array:
        """(P, ...) means of values (V, ...) by area."""
        if values.ndim > 1:
            return np.stack([self.mean(column) for column in values.T], axis=1)
        return np.asarray(np.bincount(self.patch, self.area * values, self.count) / self.size)


def find_things(mesh: MeshArrays, names: Sequence[str], is_upright: bool) -> NDArray[np.int64]:
    """(V,) the number of the thing that each vertex is of, from 0 for the one with most faces; -1 for none.

    is_upright: whether z is up and the mesh's faces look into the room, without which structure is by class alone.
    """
    if not len(mesh.faces):
        return np.full(len(mesh.vertices), -1)
    says_something, called = which(names, is_word), which(names, STRUCTURE.__contains__)
    parts = _parts(mesh, says_something)
    share_called = parts.mean(called[mesh.labels].astype(float))
    is_structure, panel = share_called > _CALLED, np.full(parts.count, -1)
    first, second, meeting = _borders(parts)
    if is_upright:
        on_plane = parts.mean(on_planes(mesh, parts.area, parts.normal).astype(float))
        named = says_something & ~called
        of_thing = parts.mean((named & ~which(names, _IN_WALLS.__contains__))[mesh.labels].astype(float))
        share_named = parts.mean(named[mesh.labels].astype(float))
        is_structure &= (on_plane > _MEETS) | _reaches_up(parts)
        is_structure |= (on_plane > _CALLED) & (share_named < _NAMED)
        is_structure |= (on_plane > _FLUSH) & (of_thing < _NAMED)
        panel = _panels(parts, is_structure, first, second)
        is_structure &= panel < 0
    votes = np.zeros((parts.count, 256))
    np.add.at(votes, (parts.patch, mesh.labels), parts.area)
    votes = votes[:, says_something] / parts.size[:, None]
    votes[panel >= 0] = 0
    cost = _cost(parts, first, second, meeting, votes)
    free = ~is_structure[first] & ~is_structure[second] & (panel[first] == panel[second])
    cost = np.where(panel[first] >= 0, 0, cost)[free]
    mass = np.maximum(parts.size / (parts.step**2 * _JOIN_AREA), 1e-3)
    group = _joined(parts, first[free], second[free], cost, mass)
    return _numbered(mesh, np.where(is_structure, -1, group)[parts.patch])


def which(names: Sequence[str], is_one: Callable[[str], bool]) -> NDArray[np.bool_]:
    """Return of which labels (256,) the name is such a one."""
    return np.array([is_one(name) for name in names] + [False] * (256 - len(names)))


def is_word(name: str) -> bool:
    """Whether the name of a class says what something is."""
    return name not in ("other", "surface", "unknown") and not name.startswith("object ")


def _parts(mesh: MeshArrays, says_something: NDArray[np.bool_]) -> Parts:
    count, points = len(mesh.vertices), mesh.vertices.astype(np.float64)
    pairs = np.sort(np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:], mesh.faces[:, ::2]]), axis=1)
    keys = np.unique(pairs[:, 0].astype(np.int64) * count + pairs[:, 1])
    edges = np.stack([keys // count, keys % count], axis=1)
    sums = normal_sums(points, mesh.faces)
    around = coo_array((np.ones(len(edges)), edges.T), shape=(count, count)).tocsr()
    around, normal = around + around.T, _unit(sums)
    for _ in range(_SMOOTH):
        normal = _unit(normal + around @ normal)
    lab = cv2.cvtColor((mesh.colors[None] / 255).astype(np.float32), cv2.COLOR_RGB2LAB)[0] * [0.5, 1, 1]
    a, b = edges.T
    between, label = points[b] - points[a], mesh.labels
    bend, hollow = 1 - (normal[a] * normal[b]).sum(1), (between * (normal[b] - normal[a])).sum(1) < 0
    renamed = (label[a] != label[b]) & says_something[label[a]] & says_something[label[b]]
    cost = np.linalg.norm(lab[a] - lab[b], axis=1) / _COLOR_UNIT + _OTHER_NAME * renamed
    cost += _BEND * np.where(hollow, 1, _CONVEX) * bend
    area = np.linalg.norm(sums, axis=1) / 6
    patch = cut_graph(a, b, cost, area / max(float(np.median(area)), 1e-12), _PATCH)
    step = float(np.median(np.linalg.norm(between, axis=1)))
    return Parts(mesh, edges, area, normal, lab.astype(np.float64), patch, bend, hollow, step)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _borders(parts: Parts) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of patches (B,), (B,) that meet, and of each edge (E,) which pair it crosses, -1 for none."""
    a, b = parts.patch[parts.edges].T
    keys, inverse = np.unique(np.minimum(a, b) * parts.count + np.maximum(a, b), return_inverse=True)
    apart = keys // parts.count != keys % parts.count
    place = np.where(apart, np.cumsum(apart) - 1, -1)
    return keys[apart] // parts.count, keys[apart] % parts.count, place[inverse]


def _cost(parts: Parts, first: NDArray, second: NDArray, meeting: NDArray, votes: Array) -> Array:
    """(B,) what it costs to join two patches that meet; votes (P, names)."""
    crosses = meeting >= 0
    border = np.bincount(meeting[crosses], minlength=len(first))
    bend = np.where(parts.hollow, 1, -1)[crosses] * parts.bend[crosses]
    inwards = np.maximum(np.bincount(meeting[crosses], bend, len(first)) / border, 0)
    color = parts.mean(parts.color)
    apart = np.linalg.norm(color[first] - color[second], axis=1)
    names = votes[first].sum(1) * votes[second].sum(1) - np.minimum(votes[first], votes[second]).sum(1)
    length = border * parts.step / np.sqrt(np.minimum(parts.size[first], parts.size[second]))
    shortness = _SHORT / np.maximum(length, 0.05)
    return np.asarray(_HOLLOW * inwards + _COLOR * apart + _NAMES * np.maximum(names, 0) + shortness)


def on_planes(mesh: MeshArrays, area: Array, normal: Array) -> NDArray[np.bool_]:
    """(V,) which vertices of an upright mesh lie on its floor or ceiling, below that, or on a wall."""
    z, upward = mesh.vertices[:, 2].astype(np.float64), normal[:, 2]
    low, high = np.quantile(z, (0.01, 0.99))
    height = max(float(high - low), 1e-9)
    on = np.zeros(len(z), bool)
    if (floor := _level(z, area * (upward > _LEVEL), area.sum(), low, height, 1)) is not None:
        on |= (upward > _ALONG) & (np.abs(z - floor) < _FLOOR_THICK * height)
        on |= z < floor - _FLOOR_THICK * height
    top = _level(z, area * (upward < -_LEVEL), area.sum(), low, height, -1)
    if top is not None and top > low + 0.6 * height:
        on |= (upward < -_ALONG) & (np.abs(z - top) < _FLOOR_THICK * height)
    for wall in find_walls(mesh.vertices, mesh.faces):
        away = mesh.vertices[:, :2].astype(np.float64) - wall.ends[0]
        along, before = away @ wall.along, away @ wall.normal
        within = (along > -_BESIDE * height) & (along < wall.length + _BESIDE * height)
        near = (before > -_BEHIND * height) & (before < _WALL_THICK * height)
        on |= within & near & (normal[:, :2] @ wall.normal > _ALONG)
    return on


def _level(z: Array, weight: Array, total: float, low: float, height: float, way: int) -> float | None:
    """The lowest (`way` 1) or highest (-1) of the heights that much of the weight (V,) lies at."""
    place = np.clip(((z - low) / height * 0.8 + 0.1) * _BINS, 0, _BINS - 1).astype(int)
    held = np.convolve(np.bincount(place, weight, _BINS), np.ones(5), "same")[::way]
    found = np.flatnonzero(held > _LEVEL_SHARE * total)
    if not len(found):
        return None
    start = max(int(found[0]) - 3, 0)
    best = start + int(held[start : found[0] + 6].argmax())
    best = best if way > 0 else _BINS - 1 - best
    return float(((best + 0.5) / _BINS - 0.1) / 0.8 * height + low)


def _height(parts: Parts) -> float:
    low, high = np.quantile(parts.mesh.vertices[:, 2], (0.01, 0.99))
    return float(high - low)


def _reaches_up(parts: Parts) -> NDArray[np.bool_]:
    """(P,) which patches stand, and reach over most of the room's height."""
    z = parts.mesh.vertices[:, 2].astype(np.float64)
    low, high = np.full(parts.count, np.inf), np.full(parts.count, -np.inf)
    np.minimum.at(low, parts.patch, z)
    np.maximum.at(high, parts.patch, z)
    return (high - low > _TALL * _height(parts)) & (parts.mean(np.abs(parts.normal[:, 2])) < _UPRIGHT)


def _panels(parts: Parts, on_plane: NDArray[np.bool_], first: NDArray, second: NDArray) -> NDArray[np.int64]:
    """(P,) the number of the picture, rug or the like that a patch on a plane is of, -1 for none."""
    color, square = parts.mean(parts.color), _height(parts) ** 2
    own = on_plane & (parts.size > _BACK * square)
    both = on_plane[first] & on_plane[second]
    alike = both & (np.linalg.norm(color[first] - color[second], axis=1) < _ALIKE)
    while (new := alike & (own[first] != own[second])).any():
        own[first[new]] = own[second[new]] = True
    other = on_plane & ~own
    inside = other[first] & other[second]
    part = components(np.stack([first[inside], second[inside]], axis=1), parts.count)
    panel = np.full(parts.count, -1)
    size = np.bincount(part, np.where(other, parts.size, 0), int(part.max()) + 1)
    for number in np.flatnonzero((size > _LEAST_PANEL * square) & (size < _MOST_PANEL * square)).tolist():
        patches = other & (part == number)
        rows = patches[parts.patch]
        normal = (parts.normal[rows] * parts.area[rows, None]).sum(0)
        flat = parts.mesh.vertices[rows] @ np.linalg.svd(normal[None])[2][1:].T
        sides = cv2.minAreaRect(flat.astype(np.float32))[1]
        if size[number] > _FILLED * sides[0] * sides[1] and min(sides) > _SLENDER * max(sides):
            panel[patches] = number
    return panel


def _joined(parts: Parts, first: NDArray, second: NDArray, cost: Array, mass: Array) -> NDArray[np.int64]:
    """(P,) the group of each patch; groups that are larger than one thing are cut again, less readily joined."""
    group, join = cut_graph(first, second, cost, mass, _JOIN), _JOIN
    for _ in range(_CUTS):
        large = np.bincount(group, parts.size)[group] > LARGEST * _height(parts) ** 2
        join *= _LESS
        inside = large[first] & (group[first] == group[second])
        again = cut_graph(first[inside], second[inside], cost[inside], mass, join)
        group = np.unique(np.where(large, again, -1) + (len(group) + 1) * group, return_inverse=True)[1]
    return group


def of_faces(numbers: NDArray[np.int64], faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """(F,) the number that two corners of a face have, of the vertices' (V,); -1 for three different ones."""
    a, b, c = numbers[faces].T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, -1))


def _numbered(mesh: MeshArrays, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """The groups (V,), -1 for none, that have enough faces, numbered from 0; a face is of what two corners are."""
    of_face = of_faces(group, mesh.faces)
    faces = np.bincount(of_face + 1, minlength=int(group.max(initial=-1)) + 2)[1:]
    order = np.argsort(-faces, kind="stable")[: int((faces >= MIN_FACES).sum())]
    number = np.full(len(faces) + 1, -1)
    number[order] = np.arange(len(order))
    return number[group]
