"""Slits and small holes of a mesh, closed with triangles between the vertices of their rims."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ....formats.mesh import MeshArrays
from ...geometry.posed_depth import PosedDepth
from ...system.jit import kernel

_SPAN, _NEAR, _MET = 32.0, 12.0, 2.0
"""In edges of the usual length: how far a new triangle reaches at most, how near to it a depth is that a view knows of
it, and how near to such a depth the mesh is. Chosen on kitchen, looked at on three more."""
_STRAIGHT = 0.99
"""A rim whose chord is a larger share of its length has no bay to fill."""
_FOLDED = -0.9
"""Cosine to the normals around up to which a triangle lies folded back over the mesh."""
_LEVELS, _GROWTH = 9, 1.5
"""Widths up to which bays are closed in turn, each so many times the one before."""


def filled(mesh: MeshArrays, views: Iterable[PosedDepth]) -> MeshArrays:
    """Close the bays of the mesh's rims that are up to `_SPAN` edges wide, with no new vertices.

    A triangle stays where at least one of the views looks at it, and no more look past it at another part of the mesh:
    between the bars of a chair the floor is seen.
    """
    points = mesh.vertices.astype(np.float64)
    if not len(rims := _rims(mesh.faces)):
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


def _rims(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """(E, 2) directed edges of one face alone, turned round, as a face beside it would have them."""
    edges = np.concatenate([faces[:, [1, 0]], faces[:, [2, 1]], faces[:, [0, 2]]]).astype(np.int64)
    count = int(faces.max(initial=-1)) + 1
    return edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]


def normal_sums(points: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return (V, 3) sums of the normals of the faces around, each twice as long as the face is large."""
    corners, total = points[faces], np.zeros_like(points)
    of_face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(total, faces[:, k], of_face)
    return total


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
