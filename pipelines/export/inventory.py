"""The things of a run: their names, boxes and numbers, in things.json and in the files that hold them."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.errors import InputError
from ...formats.ply import FARTHEST, MeshArrays, read_mesh_ply, read_mesh_things
from ..geometry.posed_depth import PosedDepth
from ..geometry.se3 import Similarity
from ..run.folder import RunFolder
from ..run.schema import RunFile
from ..scene.world import Z_UP_FROM_Y_DOWN, World
from ..system.values import dataclass_from_json
from ..system.wording import quoted
from ..types import VOID, Array
from .light import clustered
from .things import LARGEST, STRUCTURE, find_things, is_word, of_faces, which

_NAMED = 0.3
"""Share of a thing that bears a class's name, from which the thing is called so."""
_HALF_SURE = 0.03
"""Area, in squared heights of the room, at which every second thing is one that was there (see tests/benchmarks)."""
_FLAT, _LYING, _LOW = 0.06, 0.025, 0.05
"""In heights of the room: how thin a picture and a rug are at most, and up to where a rug lies."""
_STANDS = 0.05
"""In heights of the room: what is no higher over the floor stands on it."""
_TRIM = 0.005
"""Share of a thing's vertices that its box leaves out at each end."""
_SAMPLED, _AGREES, _SEEN = 20_000, 0.03, 0.1
"""Vertices by which views are counted; relative difference of depth, and share of a thing that a view sees."""
_SAME = 0.3
"""Overlap of two boxes, over their union, from which they are of one thing."""
_MOST = 2_000_000
"""Faces in which things are looked for, in about 1 GB; a mesh with more is simplified for it."""
_NUMBERED, _MOST_THINGS = re.compile(r".+ [1-9]\d{0,4}"), 65_535
"""Name of a thing, and the largest number that the files hold."""
_REACH = 10.0
"""Usual edges up to which a point belongs to the nearest vertex's thing: blurred Gaussians float that far from it."""


@dataclass(frozen=True)
class Thing:
    """number: from 1, as property `thing` of the files; label: its class (255: none), and the share of it that bears
    that; sure: how many things of its size are things indeed.

    The box is upright where the files are: center (3,), axes (3 rows: unit vectors along width, depth, height), size
    (3,) ± size_sd (3,) in the unit of the files; in metres where these are known, with the scale's deviation.
    """

    number: int
    name: str
    label: int
    class_share: float
    center: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    size: tuple[float, ...]
    size_sd: tuple[float, ...]
    faces: int
    gaussians: int
    views: int
    sure: float
    metres: tuple[float, ...] = ()
    metres_sd: tuple[float, ...] = ()

    @property
    def kind(self) -> str:
        """Its name without the number."""
        return self.name.rpartition(" ")[0]

    @property
    def called_text(self) -> str:
        """The share of it that bears its name; "by shape" where a flat box alone says so, "-" without a name."""
        if self.label != VOID:
            return f"{100 * self.class_share:.0f}%"
        return "-" if self.kind == "object" else "by shape"

    @property
    def size_text(self) -> str:
        """Width x depth x height with the unit, and how certain the longest of them is."""
        known = bool(self.metres)
        sizes, sd = (self.metres, self.metres_sd) if known else (self.size, self.size_sd)
        share = max(sd) / max(*sizes, 1e-9)
        return f"{' x '.join(f'{v:.2f}' for v in sizes)} {'m' if known else 'units'} ± {100 * min(share, 1):.0f}%"


def _checked(thing: Thing) -> Thing:
    """Raises ValueError for one that is not written here: its number is a place in arrays, its name is shown."""
    numbered = thing.name.isprintable() and _NUMBERED.fullmatch(thing.name)
    counts, metric = (thing.faces, thing.gaussians, thing.views), (thing.metres, thing.metres_sd)
    rows = [thing.center, thing.size, thing.size_sd, *thing.axes, *(metric if thing.metres else ())]
    lengths = [len(row) for row in rows]
    if not numbered or not 0 < thing.number <= _MOST_THINGS or not 0 <= thing.label <= VOID or min(counts) < 0:
        raise ValueError(f"thing {thing.name[:40]!r}: its name, number, class or a count is out of range")
    if lengths not in ([3] * 6, [3] * 8) or max(map(abs, itertools.chain(*rows))) > FARTHEST:
        raise ValueError(f"thing {thing.name[:40]!r}: a place or size of it is not three numbers within reach")
    return thing


THINGS: RunFile[tuple[Thing, ...]] = RunFile(
    "things.json", ("export",), "things",
    lambda rows: tuple(_checked(dataclass_from_json(Thing, row)) for row in rows),
    lambda things: [asdict(thing) for thing in things],
)  # fmt: skip


@dataclass(frozen=True)
class FoundThings:
    """The table, and the things' numbers (V,) of the mesh's vertices (V, 3), 0 for none, in the world of the files."""

    table: tuple[Thing, ...]
    vertices: NDArray[np.float32]
    numbers: NDArray[np.uint16]
    step: float

    @property
    def names(self) -> dict[int, str]:
        """Name of each thing by its number."""
        return {t.number: t.name for t in self.table}

    def of(self, points: NDArray[np.floating]) -> NDArray[np.uint16]:
        """(N,) number of the thing that each point (N, 3) is of: that of the nearest vertex, 0 far from all."""
        if not self.table:
            return np.zeros(len(points), np.uint16)
        nearest = self._tree.query(points, distance_upper_bound=_REACH * self.step)[1]
        there = np.isin(self.numbers, [t.number for t in self.table])
        return np.append(np.where(there, self.numbers, 0), 0).astype(np.uint16)[nearest]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.vertices)

    def on(self, vertices: NDArray[np.float32]) -> FoundThings:
        """Return the same things by other vertices (V, 3) of the same surface."""
        if len(vertices) == len(self.vertices):
            return self
        return replace(self, vertices=vertices, numbers=self.of(vertices))

    def moved(self, move: Similarity) -> FoundThings:
        """Transform mesh and boxes into another world."""
        table = tuple(
            replace(
                t, center=_plain(move.apply(np.array(t.center)[None])[0]),
                axes=tuple(_plain(move.rotation @ np.array(axis)) for axis in t.axes),
                size=_plain(move.scale * np.array(t.size)), size_sd=_plain(move.scale * np.array(t.size_sd)),
            )
            for t in self.table
        )  # fmt: skip
        vertices = move.apply(self.vertices.astype(np.float64)).astype(np.float32)
        return replace(self, table=table, vertices=vertices, step=move.scale * self.step)

    def counted(self, gaussians: NDArray[np.uint16]) -> FoundThings:
        """Write the Gaussians' counts, by their numbers (M,), into the table."""
        counts = np.bincount(gaussians, minlength=1 + max((t.number for t in self.table), default=0))
        return replace(self, table=tuple(replace(t, gaussians=int(counts[t.number])) for t in self.table))


NO_THINGS = FoundThings((), np.zeros((0, 3), np.float32), np.zeros(0, np.uint16), 0.0)


def things_in(
    mesh: MeshArrays, names: Sequence[str], world: World, views: Iterable[PosedDepth], old: Sequence[Thing] = ()
) -> FoundThings:
    """Find and describe the things of a mesh in `world`; those that were there before keep their numbers and names."""
    mesh = clustered(mesh, _MOST)
    of_vertex = find_things(mesh, names, world.axes == "up")
    edge = np.linalg.norm(mesh.vertices[mesh.faces[:, 0]] - mesh.vertices[mesh.faces[:, 1]], axis=1)
    step, seen = float(np.median(edge)) if len(edge) else 0.0, _views(mesh, of_vertex, views)
    if seen.any():  # what no view sees is a surface that was completed
        renumbered = np.where(seen > 0, np.cumsum(seen > 0) - 1, -1)
        of_vertex, seen = np.append(renumbered, -1)[of_vertex], seen[seen > 0]
    parts = zip(
        _rows(of_vertex, len(seen)), _rows(of_faces(of_vertex, mesh.faces), len(seen)), seen.tolist(), strict=True
    )
    around = Surroundings.of(mesh, names, world, step)
    table = _kept([around.described(*part) for part in parts], old)
    numbers = np.array([*(t.number for t in table), 0], np.uint16)[of_vertex]
    return FoundThings(tuple(sorted(table, key=lambda t: t.number)), mesh.vertices, numbers, step)


def _rows(numbers: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Rows with each number from 0."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def load_things(table: Path, mesh: Path) -> FoundThings:
    """Load what is in things.json and mesh.ply. Raises InputError for other files."""
    arrays, numbers = read_mesh_ply(mesh), read_mesh_things(mesh)
    edge = np.linalg.norm(arrays.vertices[arrays.faces[:, 0]] - arrays.vertices[arrays.faces[:, 1]], axis=1)
    return FoundThings(THINGS.read(table), arrays.vertices, numbers, float(np.median(edge)) if len(edge) else 0.0)


def in_metres(things: Iterable[Thing], per_unit: float | None, relative_sd: float) -> tuple[Thing, ...]:
    """Add lengths in metres, where a unit of the files is known to be so many."""
    if per_unit is None:
        return tuple(things)
    made = []
    for t in things:
        sizes = tuple(round(per_unit * v, 4) for v in t.size)
        sd = np.hypot(per_unit * np.array(t.size_sd), relative_sd * np.array(sizes))
        made.append(replace(t, metres=sizes, metres_sd=tuple(np.round(sd, 4).tolist())))
    return tuple(made)


def inventory_csv(things: Iterable[Thing]) -> str:
    """Return a table for spreadsheets: a row a thing, lengths in metres where these are known, else in units."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["number", "name", "width", "depth", "height", "unit", "x", "y", "z", "views", "faces", "gaussians", "sure"]
    )
    for t in things:
        sizes, unit = (t.metres, "m") if t.metres else (t.size, "unit")
        table.writerow([t.number, t.name, *sizes, unit, *t.center, t.views, t.faces, t.gaussians, t.sure])
    return text.getvalue()


def _views(mesh: MeshArrays, of_vertex: NDArray[np.int64], views: Iterable[PosedDepth]) -> NDArray[np.int64]:
    """(T,) how many views see each thing."""
    count = int(of_vertex.max(initial=-1)) + 1
    rows = np.flatnonzero(of_vertex >= 0)
    rows = rows[:: max(1, len(rows) // _SAMPLED)]
    points, number, seen = mesh.vertices[rows].astype(np.float64), of_vertex[rows], np.zeros(count, np.int64)
    whole = np.maximum(np.bincount(number, minlength=count), 1)
    for view in views:
        xy, z, inside = view.seen(points)
        at = np.flatnonzero(inside)
        column, row = xy[at].astype(int).T
        near = np.abs(view.depth[row, column] - z[at]) < _AGREES * z[at]
        seen += np.bincount(number[at[near]], minlength=count) > _SEEN * whole
    return seen


@dataclass(frozen=True)
class Surroundings:
    """Mesh and room by which things are described: which class names (256,) say what something is, the rotation (3, 3)
    that makes z up, the lowest place in it and the height of the room, and the usual edge."""

    mesh: MeshArrays
    names: Sequence[str]
    is_named: NDArray[np.bool_]
    turn: Array
    bottom: float
    height: float
    step: float

    @staticmethod
    def of(mesh: MeshArrays, names: Sequence[str], world: World, step: float) -> Surroundings:
        """Measure a mesh in `world`."""
        turn = np.eye(3) if world.axes == "up" else Z_UP_FROM_Y_DOWN
        z = mesh.vertices.astype(np.float64) @ turn[2]
        bottom, top = np.quantile(z, (0.01, 0.99)) if len(z) else (0.0, 1.0)
        is_named = which(names, lambda name: is_word(name) and name not in STRUCTURE)
        return Surroundings(mesh, names, is_named, turn, float(bottom), max(float(top - bottom), 1e-9), step)

    def described(self, vertices: NDArray[np.int64], faces: NDArray[np.int64], views: int) -> Thing:
        """Describe a thing by its rows of vertices and faces; without a number, and in its name."""
        corners = self.mesh.vertices[self.mesh.faces[faces]].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = float(np.linalg.norm(cross, axis=1).sum()) / 2 / self.height**2
        axes, low, high = upright_box(self.mesh.vertices[vertices].astype(np.float64) @ self.turn.T)
        if low[2] - self.bottom < _STANDS * self.height:
            low[2] = min(low[2], self.bottom)
        votes = np.bincount(self.mesh.labels[vertices], minlength=256) * self.is_named / len(vertices)
        label, share = int(votes.argmax()), float(votes.max())
        if share < _NAMED:
            label, share = VOID, 0.0
        shape = _shape((high - low) / self.height, (low[2] - self.bottom) / self.height)
        return Thing(
            number=0, name=shape if label == VOID else self.names[label], label=label, class_share=round(share, 3),
            center=_plain(((low + high) / 2 @ axes) @ self.turn), axes=tuple(_plain(axis @ self.turn) for axis in axes),
            size=_plain(high - low), size_sd=_plain(np.full(3, self.step)), faces=len(faces), gaussians=0, views=views,
            sure=round(area / (area + _HALF_SURE) * min(1.0, LARGEST / max(area, 1e-9)), 3),
        )  # fmt: skip


def _shape(size: Array, bottom: float) -> str:
    """What a thing without a name is by its shape, lengths in heights of the room."""
    if size[2] < _LYING and bottom < _LOW:
        return "rug"
    return "picture" if size[1] < _FLAT and bottom > _LOW and size[2] > _FLAT else "object"


def upright_box(points: Array) -> tuple[Array, Array, Array]:
    """Unit vectors (3, 3) along width, depth and height of points (N, 3) with z up, and least and largest coordinate
    (3,), (3,) along them, but for a few points; the width is the longer one."""
    angle = np.radians(cv2.minAreaRect(points[:, :2].astype(np.float32))[2])
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])
    low, high = np.quantile(points @ axes.T, (_TRIM, 1 - _TRIM), axis=0)
    if high[1] - low[1] > high[0] - low[0]:
        axes = np.array([axes[1], -axes[0], axes[2]])
        low, high = np.array([low[1], -high[0], low[2]]), np.array([high[1], -low[0], high[2]])
    return axes, low, high


def _plain(vector: Array) -> tuple[float, ...]:
    return tuple(np.round(vector, 6).tolist())


def _kept(found: Sequence[Thing], old: Sequence[Thing]) -> list[Thing]:
    """The things with the numbers and names of old ones whose boxes they fill; others have new ones, largest first."""
    pairs = sorted((-_overlap(t, o), n, k) for n, t in enumerate(found) for k, o in enumerate(old))
    same: dict[int, Thing] = {}
    taken: set[int] = set()
    for overlap, n, k in pairs:
        if -overlap >= _SAME and n not in same and k not in taken:
            same[n] = old[k]
            taken.add(k)
    used = {o.number for o in old}
    counts: dict[str, set[int]] = defaultdict(set)
    for o in old:
        counts[o.kind].add(int(o.name.rpartition(" ")[2]))
    made, number = [], 0
    for n, thing in enumerate(found):
        if n in same and same[n].kind == thing.name:
            made.append(replace(thing, number=same[n].number, name=same[n].name))
            continue
        if n not in same:
            number = next(i for i in itertools.count(number + 1) if i not in used)
        place = next(i for i in itertools.count(1) if i not in counts[thing.name])
        counts[thing.name].add(place)
        made.append(replace(thing, number=same[n].number if n in same else number, name=f"{thing.name} {place}"))
    return made


def _overlap(a: Thing, b: Thing) -> float:
    """Volume that the boxes around two things along the world's axes share, over that of both together."""
    (low, high), (other_low, other_high) = _around(a), _around(b)
    both = np.prod(np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0))
    return float(both / max(np.prod(high - low) + np.prod(other_high - other_low) - both, 1e-12))


def _around(thing: Thing) -> tuple[Array, Array]:
    reach = np.abs(np.array(thing.axes)).T @ np.array(thing.size) / 2 + 1e-6
    return np.array(thing.center) - reach, np.array(thing.center) + reach


@dataclass(frozen=True)
class Selection:
    """Selection of things by number, and of classes by label where they are of no thing; `only`: these are wanted, else
    all but these."""

    numbers: frozenset[int]
    labels: frozenset[int]
    only: bool

    def keeps(self, numbers: NDArray[np.uint16], labels: NDArray[np.uint8] | None) -> NDArray[np.bool_]:
        """(N,) what stays of Gaussians, vertices or faces, by thing and class."""
        named = np.isin(numbers, list(self.numbers))
        if labels is not None:
            named |= (numbers == 0) & np.isin(labels, list(self.labels))
        return named if self.only else ~named


def read_selection(run: RunFolder, only: str, without: str, names: Sequence[str]) -> Selection | None:
    """Read which things and classes are wanted, by names with commas between them; None where nothing is said.

    Raises InputError for both at once, for a name that is neither a thing nor a class, and for a run without things.
    """
    if not only and not without:
        return None
    if only and without:
        raise InputError("--only-things and --without exclude each other: name what stays, or what goes")
    table = run.find(THINGS)
    if table is None:
        raise InputError(
            f"{run.root} has no list of its things: run `msgs-slam resume {quoted(run.root)} --redo export` first"
        )
    wanted = [" ".join(word.split()).lower() for word in (only or without).split(",") if word.strip()]
    numbers, labels, unknown = set(), set(), []
    for word in wanted:
        here = {t.number for t in table if word in (t.name.lower(), t.kind.lower())}
        here_labels = {i for i, name in enumerate(names) if name.lower() == word and not word.startswith("object ")}
        if not here and not here_labels:
            unknown.append(word)
        numbers |= here
        labels |= here_labels
    if unknown:
        there = [*(t.name for t in table), *(n for n in names if is_word(n))]
        raise InputError(
            f"{run.root} has no {' and no '.join(unknown)}; there are {', '.join(there) or 'no things at all'}. "
            f"`msgs-slam list` says what and where they are"
        )
    return Selection(frozenset(numbers), frozenset(labels), bool(only))
