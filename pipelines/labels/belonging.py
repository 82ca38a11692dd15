"""Class names over the parts of a thing: it has one name where most of its parts agree."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry.voxels import Voxels, touching

_ALIKE = (
    frozenset({"bed", "seating", "sofa", "armchair", "chair", "seat", "swivel chair", "bench", "ottoman", "stool"}),
    frozenset({"cabinet", "shelf", "wardrobe", "bookcase", "chest of drawers", "buffet"}),
    frozenset({"table", "desk", "coffee table", "counter", "countertop", "kitchen island"}),
)
"""Names that one thing may bear from different sides, but not at once."""
_LEAST_AGREEMENT = 2 / 3
"""Share of a thing that bears one name already, without which it may as well be two things that touch. A table and a
chair that became one bed have 0.53; sofas of two recordings are at 0.7 and above 0.9."""


def one_name_each(share: NDArray[np.float32], names: tuple[str, ...], voxels: Voxels) -> None:
    """Connected voxels whose likeliest names may be one thing's are one thing where most of it has one of them, which
    gets what the others had. share (V, C) is changed in place."""
    for members, inside, winner in _things(share.argmax(1), names, voxels):
        agreed, name = inside[winner >= 0], members[winner[winner >= 0]]
        said = share[np.ix_(agreed, members)].sum(1)
        share[np.ix_(agreed, members)] = 0
        share[agreed, name] = said


def disputed(label: NDArray, names: tuple[str, ...], voxels: Voxels) -> NDArray[np.bool_]:
    """(V,) whether a voxel is part of a thing whose parts do not agree on its name; label (V,) indices into names, or
    any other number for none."""
    out = np.zeros(len(voxels), bool)
    for _, inside, winner in _things(label, names, voxels):
        out[inside[winner < 0]] = True
    return out


def _things(
    label: NDArray, names: tuple[str, ...], voxels: Voxels
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
    """For each set of alike names: their indices (M,), the voxels (I,) that bear one, and for each of these which of
    the names most of its thing bears, -1 where too little of it does."""
    for alike in _ALIKE:
        members = np.flatnonzero([n.lower() in alike for n in names])
        inside = np.flatnonzero(np.isin(label, members))
        if len(members) < 2 or len(inside) == 0:
            continue
        own = np.searchsorted(members, label[inside])
        thing = _touching(voxels.keys[inside])
        votes = csr_matrix((voxels.weight[inside], (thing, own)), (thing.max() + 1, len(members))).toarray()
        agrees = votes.max(1) >= _LEAST_AGREEMENT * votes.sum(1)
        yield members, inside, np.where(agrees, votes.argmax(1), -1)[thing]


def _touching(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(V,) number of the connected piece of each of the sorted keys."""
    a, b = touching(keys)
    links = csr_matrix((np.ones(len(a), bool), (a, b)), (len(keys), len(keys)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
