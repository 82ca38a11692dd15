"""The zero surface of a sparse distance field as triangles: marching cubes chunk by chunk, welded.

The regions of a long recording become one mesh without floaters, with no more than one of them in memory (`joined`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ...formats.ply import MeshArrays, MeshBlocks, normal_sums
from ..geometry.camera import project
from ..geometry.posed_depth import PosedDepth
from ..system.jit import kernel
from .volume import CHUNK, HINT, SIDE, Volume, chunk_keys

MIN_PIECE = 0.01
"""Connected pieces with fewer faces than this share of the largest one's are floaters."""

_STEPS = 1000
"""Vertices within so small a part of a voxel are the same."""
_SPAN, _NEAR, _MET = 16.0, 12.0, 2.0
"""In edges of the usual length: how far a new triangle reaches at most, how near to it a depth is that a view knows of
it, and how near to such a depth the mesh is. Chosen on kitchen, looked at on three more."""
_STRAIGHT = 0.99
"""A rim whose chord is a larger share of its length has no bay to fill."""
_FOLDED = -0.9
"""Cosine to the normals around up to which a triangle lies folded back over the mesh."""
_LEVELS, _GROWTH = 7, 1.5
"""Widths up to which bays are closed in turn, each so many times the one before."""


@dataclass(frozen=True)
class Surface:
    """vertices (V, 3) in the world, faces (F, 3); pieces (V,), which connected piece each vertex belongs to, -1 without
    a face. The vertices `border` (N,), which those of other regions may be, have the places `border_places` (N, 3) in
    thousandths of a voxel; hinted (F,): faces that no view sees, but that hints say bound what is solid."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    pieces: NDArray[np.int32]
    border: NDArray[np.int64]
    border_places: NDArray[np.int64]
    hinted: NDArray[np.bool_]


Triangles = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.bool_]]
"""Places (V, 3), faces (F, 3), and which of these no view sees (F,), but hints say are solid."""


def chunk_surfaces(volume: Volume, chunks: NDArray[np.int32], least_weight: float) -> list[Triangles]:
    """The surface in each of these chunks; only where all eight corners of a cell were seen, or hinted at as solid."""
    index = {tuple(b): n for n, b in enumerate(volume.blocks.tolist())}
    ordered = chunks[np.lexsort(chunks.T[::-1])]
    return [_chunk_surface(volume, index, chunk * CHUNK, least_weight) for chunk in ordered]


def _chunk_surface(
    volume: Volume, index: dict[tuple[int, ...], int], first: NDArray[np.int32], least_weight: float
) -> Triangles:
    """The surface in one chunk; its last layer of voxels is its neighbours' first, so that no cell is left out."""
    size = CHUNK * SIDE + 1
    distance = np.ones((size, size, size), np.float32)
    seen, sure = np.zeros((2, size, size, size), bool)
    for dx in range(CHUNK + 1):
        for dy in range(CHUNK + 1):
            for dz in range(CHUNK + 1):
                n = index.get((int(first[0]) + dx, int(first[1]) + dy, int(first[2]) + dz))
                if n is None:
                    continue
                place = tuple(slice(d * SIDE, min(d * SIDE + SIDE, size)) for d in (dx, dy, dz))
                cut = tuple(slice(0, s.stop - s.start) for s in place)
                distance[place] = volume.distance[n][cut]
                weight = volume.weight[n][cut]
                sure[place] = weight >= least_weight
                seen[place] = sure[place] | ((weight >= HINT * least_weight) & (distance[place] < 0))
    distance[~seen] = 1
    if distance.min() >= 0:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, bool)
    # Free space is positive: "descent" makes the faces look that way.
    points, triangles, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    cell = tuple(np.floor(points[triangles].mean(1)).astype(int).clip(0, size - 2).T)
    is_whole = _whole_cells(seen)[cell]
    kept, hinted = triangles[is_whole], ~_whole_cells(sure)[cell][is_whole]
    used = np.unique(kept)
    renumber = np.zeros(len(points), np.int32)
    renumber[used] = np.arange(len(used))
    return (points[used] + first * SIDE) * volume.voxel, renumber[kept], hinted


def _whole_cells(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n-1, n-1, n-1): all eight corners were seen."""
    out = seen[:-1] & seen[1:]
    out = out[:, :-1] & out[:, 1:]
    return out[:, :, :-1] & out[:, :, 1:]


def weld(parts: Sequence[Triangles], chunks: NDArray[np.int32], voxel: float) -> Surface:
    """The surface in a region of chunks: vertices that neighbours share become one, triangles without area go."""
    firsts = np.cumsum([0, *(len(points) for points, _, _ in parts)], dtype=np.int32)
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _, _ in parts)])
    keys = np.round(points / (voxel / _STEPS)).astype(np.int64)
    order = np.lexsort(keys.T[::-1])  # that of rows; np.unique's needs ten times the time and twice the memory
    is_new = np.ones(len(keys), bool)
    is_new[1:] = (keys[order[1:]] != keys[order[:-1]]).any(1)
    one = np.empty(len(keys), np.int32)
    one[order] = np.cumsum(is_new, dtype=np.int32) - np.int32(1)
    first = order[is_new]
    vertices, keys = points[first].astype(np.float32), keys[first]
    del points, order
    no_faces = np.zeros((0, 3), np.int32)
    faces = one[np.concatenate([no_faces, *(f + start for (_, f, _), start in zip(parts, firsts, strict=False))])]
    hinted = np.concatenate([np.zeros(0, bool), *(h for _, _, h in parts)])
    has_area = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    border = _border(keys, chunks)
    faces, hinted = faces[has_area], hinted[has_area]
    return Surface(vertices, faces, _pieces(faces, len(vertices)), border, keys[border], hinted)


def closed(surface: Surface, views: Iterable[PosedDepth], reach: float) -> Surface:
    """The surface with those hinted faces alone that a view needs: there it knows a depth, within
    `reach` of the face, but sees no other one."""
    needed = ~surface.hinted
    for view in views:
        pose = view.cam_from_world
        xy, z = project(surface.vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3], view.intrinsics)
        z = np.where(np.isfinite(xy).all(1) & (z > 0), z, 0)
        _need(np.nan_to_num(xy), z, surface.faces, surface.hinted, view.trust <= 0, view.depth, reach, needed)
    faces = surface.faces[needed]
    pieces = _pieces(faces, len(surface.vertices))
    return replace(surface, faces=faces, pieces=pieces, hinted=surface.hinted[needed])


@kernel
def _need(xy, z, faces, hinted, covered, depth, reach, needed):  # type: ignore[no-untyped-def]
    """Mark the pixels (H, W) whose centre a seen face covers, then the hinted faces that cover others."""
    height, width = covered.shape
    for second in (False, True):
        for f in range(len(faces)):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if hinted[f] != second or (second and needed[f]) or z[a] <= 0 or z[b] <= 0 or z[c] <= 0:
                continue
            ax, ay, bx, by, cx, cy = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1], xy[c, 0], xy[c, 1]
            top, bottom = max(min(ay, by, cy), 0.0), min(max(ay, by, cy), height - 0.5)
            left, right = max(min(ax, bx, cx), 0.0), min(max(ax, bx, cx), width - 0.5)
            sign = 1.0 if (bx - ax) * (cy - ay) > (cx - ax) * (by - ay) else -1.0
            for row in range(int(top), int(bottom + 0.5)):
                y = row + 0.5
                for column in range(int(left), int(right + 0.5)):
                    x = column + 0.5
                    if (
                        sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) >= 0
                        and sign * ((cx - bx) * (y - by) - (cy - by) * (x - bx)) >= 0
                        and sign * ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) >= 0
                    ):
                        if not second:
                            covered[row, column] = True
                        elif not covered[row, column] and abs(depth[row, column] - (z[a] + z[b] + z[c]) / 3) < reach:
                            needed[f] = True


def _border(places: NDArray[np.int64], chunks: NDArray[np.int32]) -> NDArray[np.int64]:
    """The rows of places on a side of a chunk that is not among these: the others know them too."""
    chunk, inside = np.divmod(places, CHUNK * SIDE * _STEPS)
    rows = np.flatnonzero((inside == 0).any(1))
    chunk, is_side, own = chunk[rows], inside[rows] == 0, chunk_keys(chunks)
    shared = np.zeros(len(rows), bool)
    for back in itertools.product((0, 1), repeat=3):
        shared |= is_side[:, np.flatnonzero(back)].all(1) & ~np.isin(chunk_keys(chunk - np.array(back)), own)
    return rows[shared]


def _pieces(faces: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """(count,) numbers from 0 of the connected pieces, -1 for a vertex without a face."""
    number, used = np.full(count, -1, np.int32), np.unique(faces)
    joined = components(np.concatenate([faces[:, :2], faces[:, 1:]]), count)[used]
    number[used] = np.unique(joined, return_inverse=True)[1]
    return number


def components(edges: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """(count,) the number of the connected component of each node, by edges (E, 2)."""
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


@dataclass(frozen=True)
class Region:
    """A part of the mesh, with colors (V, 3) uint8 and labels (V,) uint8 of its vertices."""

    surface: Surface
    colors: NDArray[np.uint8]
    labels: NDArray[np.uint8]


@dataclass(frozen=True)
class _Sizes:
    """What stays in memory of a region: of each of its pieces (P,) the faces, and the vertices that no other region
    has; of its border (N,) the pieces, -1 for none, and the places (N, 3)."""

    faces: NDArray[np.int64]
    inner: NDArray[np.int64]
    border: NDArray[np.int32]
    places: NDArray[np.int64]

    @staticmethod
    def of(surface: Surface) -> _Sizes:
        """Of one region."""
        count = int(surface.pieces.max(initial=-1)) + 1
        border = surface.pieces[surface.border]
        inner = np.bincount(surface.pieces + 1, minlength=count + 1) - np.bincount(border + 1, minlength=count + 1)
        faces = np.bincount(surface.pieces[surface.faces[:, 0]], minlength=count)
        return _Sizes(faces, inner[1:], border, surface.border_places)


@dataclass(frozen=True)
class _Chosen:
    """Of one region: whether each of its pieces stays (P + 1,), the last for none; of its border (N,) the numbers of
    the places, and whether the vertex there is written with this region, as the first that has it."""

    pieces: NDArray[np.bool_]
    place: NDArray[np.int64]
    written: NDArray[np.bool_]

    def rows(self, surface: Surface) -> NDArray[np.bool_]:
        """(V,) which vertices are written with this region."""
        kept = self.pieces[surface.pieces]
        kept[surface.border] = self.written
        return kept


def joined(regions: Callable[[], Iterable[Region]], least_share: float = MIN_PIECE) -> MeshBlocks:
    """The mesh of these regions, a block each, without pieces with less than `least_share` of the largest's faces."""
    sizes = [_Sizes.of(region.surface) for region in regions()]
    chosen = _choose(sizes, least_share)
    kept = [(s, c.pieces[:-1]) for s, c in zip(sizes, chosen, strict=True)]
    inner, faces = sum(int(s.inner[k].sum()) for s, k in kept), sum(int(s.faces[k].sum()) for s, k in kept)

    def vertices() -> Iterator[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]]:
        for region, c in zip(regions(), chosen, strict=True):
            rows = c.rows(region.surface)
            yield region.surface.vertices[rows], region.colors[rows], region.labels[rows]

    count = inner + sum(int(c.written.sum()) for c in chosen)
    return MeshBlocks(count, faces, vertices, lambda: _faces((region.surface for region in regions()), chosen))


def _choose(sizes: Sequence[_Sizes], least_share: float) -> list[_Chosen]:
    """Pieces of different regions are one where they share a place."""
    starts = np.cumsum([0, *(len(s.faces) for s in sizes)])
    no_places = np.zeros((0, 3), np.int64)
    places, first, place = np.unique(
        np.concatenate([no_places, *(s.places for s in sizes)]), axis=0, return_index=True, return_inverse=True
    )
    place, count = place.reshape(-1), int(starts[-1])
    numbers = (np.where(s.border < 0, -1, s.border + a) for s, a in zip(sizes, starts, strict=False))
    piece = np.concatenate([np.zeros(0, int), *numbers])
    used = piece >= 0
    whole = components(np.stack([piece[used], place[used] + count], 1), count + len(places))[:count]
    faces = np.bincount(whole, np.concatenate([np.zeros(0), *(s.faces for s in sizes)]))
    stays = np.append(faces[whole] >= least_share * faces.max(initial=0), False)
    place_stays = np.zeros(len(places), bool)
    place_stays[place[stays[piece]]] = True
    written = np.zeros(len(place), bool)
    written[first] = place_stays
    ends = np.cumsum([0, *(len(s.border) for s in sizes)])
    both = zip(pairwise(starts), pairwise(ends), strict=True)
    return [_Chosen(np.append(stays[a:b], False), place[c:d], written[c:d]) for (a, b), (c, d) in both]


def _faces(surfaces: Iterator[Surface], chosen: Sequence[_Chosen]) -> Iterator[NDArray[np.int32]]:
    row_of_place = np.zeros(max((int(c.place.max(initial=-1)) + 1 for c in chosen), default=0), np.int32)
    start = 0
    for surface, c in zip(surfaces, chosen, strict=True):
        kept = c.rows(surface)
        row = np.cumsum(kept, dtype=np.int32) + np.int32(start - 1)
        row_of_place[c.place[c.written]] = row[surface.border[c.written]]
        row[surface.border] = row_of_place[c.place]
        yield row[surface.faces[c.pieces[surface.pieces[surface.faces[:, 0]]]]]
        start += int(kept.sum())


def filled(mesh: MeshArrays, views: Iterable[PosedDepth]) -> MeshArrays:
    """Close the bays of the mesh's rims that are up to `_SPAN` edges wide, with no new vertices.

    A triangle stays where at least one of the views looks at it, and no more look past it at another part of the mesh:
    between the bars of a chair the floor is seen.
    """
    points, count = mesh.vertices.astype(np.float64), len(mesh.vertices)
    # Directed edges of one face alone, turned round, as a face beside it would have them.
    edges = np.concatenate([mesh.faces[:, [1, 0]], mesh.faces[:, [2, 1]], mesh.faces[:, [0, 2]]]).astype(np.int64)
    rims = edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]
    if not len(rims):
        return mesh
    edge = float(np.median(np.linalg.norm(points[mesh.faces[:, 0]] - points[mesh.faces[:, 1]], axis=1)))
    order = np.argsort(rims[:, 0], kind="stable")
    after = _chained(points, rims, order, np.searchsorted(rims[order, 0], rims[:, 1]))
    normals = normal_sums(points, mesh.faces)
    new = _clipped(points, normals, rims, after, edge, _SPAN * edge)
    normal = np.cross(points[new[:, 1]] - points[new[:, 0]], points[new[:, 2]] - points[new[:, 0]])
    around = normals[new].sum(1)
    folded = (normal * around).sum(1) < _FOLDED * np.linalg.norm(normal, axis=1) * np.linalg.norm(around, axis=1)
    new = new[~folded]
    new = new[_is_seen(points[new].mean(1), points, views, edge)]
    return replace(mesh, faces=np.concatenate([mesh.faces, new.astype(np.int32)]))


@kernel
def _chained(points, rims, order, first):  # type: ignore[no-untyped-def]
    """(E,) the edge that goes on where each ends, -1 = none; of several free ones the one that turns back most."""
    after, taken = np.full(len(rims), -1), np.zeros(len(rims), np.bool_)
    for e in range(len(rims)):
        least = np.inf
        for k in range(first[e], len(rims)):
            f = order[k]
            if rims[f, 0] != rims[e, 1]:
                break
            across = ((points[rims[f, 1]] - points[rims[e, 0]]) ** 2).sum()
            if not taken[f] and across < least:
                least, after[e] = across, f
        if after[e] >= 0:
            taken[after[e]] = True
    return after


@kernel
def _clipped(points, normals, rims, after, edge, most):  # type: ignore[no-untyped-def]
    """(T, 3) triangles between neighbouring edges of the rims, each of which makes one edge of two (changed in place):
    narrow ones first, so that a slit is sewn together from its ends, and first of all those that lie as the faces
    beside them do."""
    alive, new, count = np.ones(len(rims), np.bool_), np.empty((len(rims), 3), np.int64), 0
    for number in range(2 * _LEVELS):
        widest, changed = min(edge * _GROWTH ** (number % _LEVELS + 1), most), True
        while changed:
            changed = False
            for e in range(len(rims)):
                f = after[e]
                if not alive[e] or f < 0 or f == e:
                    continue
                a, b, c = rims[e, 0], rims[e, 1], rims[f, 1]
                if a == c:
                    alive[e], alive[f] = False, False
                    continue
                first, second = points[b] - points[a], points[c] - points[b]
                chord, length = np.sqrt(((first + second) ** 2).sum()), np.sqrt((first**2).sum())
                if chord > widest or chord > _STRAIGHT * (length + np.sqrt((second**2).sum())):
                    continue
                along = (np.cross(first, second) * (normals[a] + normals[b] + normals[c])).sum()
                if number < _LEVELS and along <= 0:
                    continue
                new[count, 0], new[count, 1], new[count, 2] = a, b, c
                count += 1
                rims[e, 1], after[e], alive[f], changed = c, after[f], False, True
    return new[:count]


def _is_seen(
    middles: NDArray[np.float64], points: NDArray[np.float64], views: Iterable[PosedDepth], edge: float
) -> NDArray[np.bool_]:
    """(T,) where at least one view looks at a place, and no more look past it at vertices of the mesh."""
    supports, opposes, surface = *np.zeros((2, len(middles)), np.int64), cKDTree(points)
    for view in views:
        xy, z, is_inside = view.seen(middles)
        inside = np.flatnonzero(is_inside)
        column, row = xy[inside].astype(int).T
        beyond, trusted = view.depth[row, column] - z[inside], view.trust[row, column] > 0
        past = np.flatnonzero(trusted & (beyond > _NEAR * edge))
        shown = view.in_world(xy[inside[past]], z[inside[past]] + beyond[past])
        is_mesh = surface.query(shown, distance_upper_bound=_MET * edge)[0] < np.inf
        supports[inside] += ~trusted | (beyond >= -_NEAR * edge)
        supports[inside[past[is_mesh]]] -= 1
        opposes[inside[past[is_mesh]]] += 1
    return np.asarray(supports >= np.maximum(opposes, 1))
