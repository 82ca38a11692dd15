"""The regions of a mesh as one: welded where they meet and without floaters, with no more than one in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...formats.mesh import MeshBlocks
from .surface import Surface

LEAST_PIECE = 0.01
"""Connected pieces with fewer faces than this share of the largest one's are floaters."""


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


def joined(regions: Callable[[], Iterable[Region]], least_share: float = LEAST_PIECE) -> MeshBlocks:
    """The mesh of these regions, a block each, without the connected pieces that have fewer faces than `least_share` of
    the largest one's."""
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
    graph = coo_array(
        (np.ones(int(used.sum()), bool), (piece[used], place[used] + count)), shape=(count + len(places),) * 2
    )
    whole = connected_components(graph, directed=False)[1][:count]
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
