"""What the rest of the scene says of a name: an object has one, and a room holds no cars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from msgs_slam.pipelines.voxels.voxels import Voxels, touching

_ALIKE = (
    frozenset({"bed", "seating", "sofa", "armchair", "chair", "seat", "swivel chair", "bench", "ottoman", "stool"}),
    frozenset({"cabinet", "shelf", "wardrobe", "bookcase", "chest of drawers", "buffet"}),
    frozenset({"table", "desk", "coffee table", "counter", "countertop", "kitchen island"}),
)
"""Names that one thing may bear from different sides, but not at once."""
_OUTSIDE = frozenset(
    {"building", "sky", "tree", "road", "grass", "sidewalk", "earth", "mountain", "car", "water", "house", "sea"}
    | {"field", "rock", "sand", "skyscraper", "path", "runway", "river", "bridge", "hill", "boat", "bus", "truck"}
)
_MOSTLY = 0.8
_UNLIKELY = float(np.exp(-2.0))


def place_likelihood(
    share: NDArray[np.float32], names: tuple[str, ...], weight: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(C,) factor of every name's probability: where nearly all of the surface has names from indoors, less for those
    from outdoors. share (V, C); weight (V,) sums to 1."""
    outside = np.array([n.lower() in _OUTSIDE for n in names])
    is_inside = weight[~outside[share.argmax(1)]].sum() > _MOSTLY
    return np.where(outside & is_inside, _UNLIKELY, 1).astype(np.float32)


def one_name_each(share: NDArray[np.float32], names: tuple[str, ...], voxels: Voxels) -> None:
    """Connected voxels whose likeliest names may be one thing's are one thing: its likeliest name gets what the
    others had. share (V, C) is changed in place."""
    best = share.argmax(1)
    for alike in _ALIKE:
        members = np.flatnonzero([n.lower() in alike for n in names])
        inside = np.flatnonzero(np.isin(best, members))
        if len(members) < 2 or len(inside) == 0:
            continue
        thing = _touching(voxels.keys[inside])
        said = share[np.ix_(inside, members)]
        total = csr_matrix((voxels.weight[inside], (thing, np.arange(len(inside))))) @ said
        share[np.ix_(inside, members)] = 0
        share[inside, members[total.argmax(1)[thing]]] = said.sum(1)


def _touching(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(V,) number of the connected piece of each of the sorted keys."""
    a, b = touching(keys)
    links = csr_matrix((np.ones(len(a), bool), (a, b)), (len(keys), len(keys)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
