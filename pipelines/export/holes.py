"""A map and a mesh without some of their things: what goes, and the floor and walls that continue there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_dilation
from scipy.spatial import cKDTree

from ...formats.glb import ClassMesh
from ...formats.ply import MeshArrays
from ..render.gaussian_map import DECIDED_LOGIT, GaussianMap
from ..run.outcome import Outcome
from ..scene.world import World
from ..types import VOID, Array
from .inventory import Selection
from .walls import find_walls

_CELL = 2.0
"""Usual edges of the mesh along a side of the cells that are filled."""
_ON, _TOUCHES, _BEFORE = 0.03, 0.06, 0.35
"""In heights of the room: how near to a plane what covers it lies, how near a thing comes that stands on it or against
it, and how far before it what goes may have hidden it."""
_JOINED = 3
"""Cells over which gaps in what a thing hid are closed."""
_COLORS = 6
"""Vertices whose mean colour a cell takes."""
_LARGEST = 4_000_000
"""Cells of a plane; a larger one is left as it is."""
_OPACITY, _RADIUS = 4.0, 0.6
"""Logit of a new Gaussian's opacity, and its radius in cells."""


@dataclass(frozen=True)
class Hole:
    """A part of a plane that nothing covers: a grid (h, w) of points (h, w, 3) with colours (h, w, 3), which of them
    are `wanted`, and the label of the plane; rows and columns turn with the normal by the right-hand rule."""

    points: Array
    colors: NDArray[np.uint8]
    wanted: NDArray[np.bool_]
    label: int

    def triangles(self) -> NDArray[np.int64]:
        """(F, 3) two of each square whose four points are wanted, as rows of the flattened grid."""
        w, number = self.wanted, np.arange(self.wanted.size).reshape(self.wanted.shape)
        row, column = np.nonzero(w[:-1, :-1] & w[1:, :-1] & w[:-1, 1:] & w[1:, 1:])
        a, b = number[row, column], number[row, column + 1]
        c, d = number[row + 1, column + 1], number[row + 1, column]
        return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def gone(selection: Selection, numbers: NDArray[np.uint16], labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(N,) what is a thing, or of a class, that is not wanted, where the rest of the room stays."""
    return np.zeros(len(numbers), bool) if selection.only else ~selection.keeps(numbers, labels)


def holes_in(mesh: MeshArrays, numbers: NDArray[np.uint16], selection: Selection, world: World) -> list[Hole]:
    """The floor and walls of the mesh (V,) where what goes hid them; none where up is unknown."""
    away = gone(selection, numbers, mesh.labels)
    if world.axes != "up" or not away.any():
        return []
    points = mesh.vertices.astype(np.float64)
    edges = np.linalg.norm(points[mesh.faces[:, 0]] - points[mesh.faces[:, 1]], axis=1)
    cell = _CELL * float(np.median(edges))
    low, high = np.quantile(points[:, 2], (0.01, 0.99))
    height, up = float(high - low), np.array([0.0, 0, 1])
    planes = []
    if world.has_floor:
        endless = np.full(2, np.inf)
        planes.append(((np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])), (-endless, endless)))
    for wall in find_walls(mesh.vertices, mesh.faces):
        along = np.array([*wall.along, 0.0])
        start = np.array([*wall.ends[0], low])
        planes.append(((start, along, up), (np.zeros(2), np.array([wall.length, height]))))
    found = (_hole(mesh, away, numbers, plane, sides, cell, height) for plane, sides in planes)
    return [hole for hole in found if hole is not None]


def _hole(
    mesh: MeshArrays,
    away: NDArray[np.bool_],
    numbers: NDArray[np.uint16],
    plane: tuple[Array, Array, Array],
    sides: tuple[Array, Array],
    cell: float,
    height: float,
) -> Hole | None:
    """Of one plane, a place on it and two directions whose cross product looks into the room, between two `sides` (2,)
    of it."""
    start, first, second = plane
    normal = np.cross(first, second)
    at = mesh.vertices.astype(np.float64) - start
    u, v, off = at @ first, at @ second, at @ normal
    flat = np.stack([u, v], axis=1)
    inside = ((flat > sides[0] - cell) & (flat < sides[1] + cell)).all(axis=1)
    meets = np.unique(numbers[away & (off < _TOUCHES * height) & inside])
    reach = np.inf if abs(normal[2]) > 0.5 else _BEFORE * height
    hides = away & inside & np.isin(numbers, meets) & (off < reach) & (off > -_TOUCHES * height)
    covers = ~away & inside & (np.abs(off) < _ON * height)
    covers[np.setdiff1d(np.arange(len(covers)), mesh.faces)] = False
    if not hides.any() or not covers.any():
        return None
    margin = _JOINED + 2
    low = flat[hides].min(axis=0) - margin * cell
    size = np.ceil((flat[hides].max(axis=0) - low) / cell).astype(int) + margin
    if np.prod(size) > _LARGEST:
        return None

    def cells(rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        grid = np.zeros((size[1], size[0]), bool)
        place = np.floor((flat[rows] - low) / cell).astype(int)
        place = place[((place >= 0) & (place < size)).all(axis=1)]
        grid[place[:, 1], place[:, 0]] = True
        return grid

    hidden = binary_closing(binary_dilation(cells(hides)), np.ones((3, 3)), iterations=_JOINED)
    bare = hidden & ~cells(covers)
    if not bare.any():
        return None
    wanted = binary_dilation(bare, np.ones((3, 3)))
    rows, columns = np.mgrid[: size[1], : size[0]]
    middle = low + cell * (np.stack([columns, rows], -1) + 0.5)
    wanted &= ((middle > sides[0]) & (middle < sides[1])).all(axis=-1)
    points = start + middle[..., :1] * first + middle[..., 1:] * second
    near = np.flatnonzero(covers)
    nearest = cKDTree(flat[near]).query(middle.reshape(-1, 2), k=min(_COLORS, len(near)))[1]
    nearest = nearest.reshape(middle[..., 0].size, -1)
    colors = mesh.colors[near][nearest].mean(axis=1).round().astype(np.uint8).reshape(*middle.shape[:2], 3)
    label = int(np.bincount(mesh.labels[near], minlength=256).argmax())
    return Hole(points, colors, wanted, label)


def cut_mesh(
    mesh: MeshArrays, numbers: NDArray[np.uint16], selection: Selection, world: World
) -> tuple[MeshArrays, NDArray[np.uint16]]:
    """The faces whose corners are wanted, the holes filled, and the numbers of the vertices' things."""
    kept = selection.keeps(numbers, mesh.labels)
    faces = mesh.faces[kept[mesh.faces].sum(axis=1) >= 2]
    used, corners = np.unique(faces, return_inverse=True)
    parts = [(mesh.vertices[used], corners.reshape(-1, 3), mesh.colors[used], mesh.labels[used])]
    held, count = [np.where(kept[used], numbers[used], 0)], len(used)
    for hole in holes_in(mesh, numbers, selection, world):
        corner, triangles = np.unique(hole.triangles(), return_inverse=True)
        colors = hole.colors.reshape(-1, 3)[corner]
        parts.append((
            hole.points.reshape(-1, 3)[corner], triangles.reshape(-1, 3) + count, colors,
            np.full(len(corner), hole.label, np.uint8),
        ))  # fmt: skip
        held.append(np.zeros(len(corner), np.uint16))
        count += len(corner)
    vertices, faces, colors, labels = (np.concatenate(column) for column in zip(*parts, strict=True))
    made = MeshArrays(vertices.astype(np.float32), faces.astype(np.int32), colors, labels)
    return made, np.concatenate(held).astype(np.uint16)


def cut_light(mesh: ClassMesh, selection: Selection, holes: Sequence[Hole]) -> ClassMesh | None:
    """The faces that are wanted, and those of the holes, hidden ones, whose colours are added to the texture as grids;
    None where nothing is left."""
    things = np.zeros(len(mesh.labels), np.uint16) if mesh.things is None else mesh.things
    hidden = np.zeros(len(mesh.labels), bool) if mesh.hidden is None else mesh.hidden
    kept = selection.keeps(things, mesh.labels)
    if not kept.any():
        return None
    made = replace(mesh, faces=mesh.faces[kept], labels=mesh.labels[kept], things=things[kept], hidden=hidden[kept])
    for hole in holes:
        made = _with_hole(made, hole)
    return made


def _with_hole(mesh: ClassMesh, hole: Hole) -> ClassMesh:
    corner, faces = np.unique(hole.triangles(), return_inverse=True)
    if not len(corner):
        return mesh
    texture, uv = mesh.texture, mesh.corner_uv
    place = np.zeros((len(corner), 2), np.float32)
    if texture.size:
        tall, (height, width) = len(texture), hole.wanted.shape
        across = max(texture.shape[1], width)
        canvas = np.zeros((tall + height, across, 3), np.uint8)
        canvas[:tall, : texture.shape[1]], canvas[tall:, :width] = texture, hole.colors
        uv = uv * np.array([texture.shape[1] / across, tall / len(canvas)], np.float32)
        row, column = np.divmod(corner, width)
        place = np.stack([(column + 0.5) / across, (tall + row + 0.5) / len(canvas)], 1).astype(np.float32)
        texture = canvas
    count, made = len(mesh.vertices), len(faces.reshape(-1, 3))
    assert mesh.things is not None
    assert mesh.hidden is not None
    return ClassMesh(
        np.concatenate([mesh.vertices, hole.points.reshape(-1, 3)[corner].astype(np.float32)]),
        np.concatenate([mesh.colors, hole.colors.reshape(-1, 3)[corner]]),
        np.concatenate([mesh.labels, np.full(made, hole.label, np.uint8)]),
        np.concatenate([mesh.corner_vertex, count + np.arange(len(corner))]),
        np.concatenate([uv, place]),
        np.concatenate([mesh.faces, faces.reshape(-1, 3) + len(mesh.corner_vertex)]).astype(np.int32),
        texture,
        np.concatenate([mesh.hidden, np.ones(made, bool)]),
        np.concatenate([mesh.things, np.zeros(made, np.uint16)]),
    )


def cut_map(outcome: Outcome, numbers: NDArray[np.uint16], selection: Selection, holes: Sequence[Hole]) -> GaussianMap:
    """The Gaussians that are wanted, by the numbers (M,) of their things, and new ones in the holes."""
    m, channels = outcome.require_map(), outcome.label_of_channel
    labels = None
    if len(channels):
        labels = channels[m.class_logits.argmax(dim=1).cpu().numpy()]
    kept = m.only(torch.from_numpy(selection.keeps(numbers, labels)).to(m.means.device))
    parts = [kept, *(_filling(m, hole, channels) for hole in holes)]
    return GaussianMap(**{name: torch.cat([vars(part)[name] for part in parts]) for name in vars(m)})


def _filling(m: GaussianMap, hole: Hole, channels: NDArray[np.uint8]) -> GaussianMap:
    points, colors = hole.points[hole.wanted], hole.colors[hole.wanted]
    cell = float(np.linalg.norm(hole.points[0, 1] - hole.points[0, 0]))
    count, logits = len(points), m.class_logits.new_zeros((len(points), m.class_logits.shape[1]))
    if hole.label != VOID and hole.label in channels.tolist():
        logits[:, channels.tolist().index(hole.label)] = 3 * DECIDED_LOGIT
    return GaussianMap(
        m.means.new_tensor(points.tolist()),
        m.means.new_full((count,), float(np.log(_RADIUS * cell))),
        m.means.new_full((count,), _OPACITY),
        m.means.new_tensor((colors / 255).tolist()),
        logits,
        m.anchor_frame_ids.new_zeros(count),
    )
