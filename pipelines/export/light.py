"""A lighter mesh: fewer faces, of which none reaches over the border of a class, with smooth rims.

Faces are taken away by quadrics (Garland and Heckbert 1997).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.ply import MeshArrays, normal_sums
from ..geometry.voxels import voxel_keys
from .surface import components

SHARE = 0.1
"""Faces that are kept of a mesh with a texture: it needs to follow the shape only."""
_FEWEST = 4
"""Faces that a mesh is not simplified below."""
_SMOOTH = 5.0
"""How readily fast-simplification goes on to worse edges (its `agg`; lower is slower and keeps the shape better)."""
_LINE = 1e-4
"""Area over the square of the longest side up to which a triangle is a line."""
_MOST = 4_000_000
"""Faces that are simplified at once, in 0.5 GB."""
_SPOT = 200
"""A class has at least so many faces in a place; smaller spots become as what is around them."""
_ROUNDS = 8
"""How often a rim's vertices move half of the way to the middle between their neighbours."""


def clustered(mesh: MeshArrays, most: int = _MOST) -> MeshArrays:
    """The mesh where it has at most so many faces; else with one vertex for all in a cube of a grid."""
    while len(mesh.faces) > most:
        places = mesh.vertices.astype(np.float64)
        edge = np.median(np.linalg.norm(places[mesh.faces[:, 0]] - places[mesh.faces[:, 1]], axis=1))
        _, first, number = np.unique(voxel_keys(places, 2 * float(edge)), return_index=True, return_inverse=True)
        mesh = _with_faces(mesh, first, number.reshape(-1)[mesh.faces])
    return mesh


def _with_faces(mesh: MeshArrays, rows: NDArray[np.int64], faces: NDArray[np.integer]) -> MeshArrays:
    """These vertices of a mesh, and those of the `faces` that have three different ones."""
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return MeshArrays(mesh.vertices[rows], faces[whole].astype(np.int32), mesh.colors[rows], mesh.labels[rows])


def lightened(mesh: MeshArrays, most: int) -> tuple[MeshArrays, NDArray[Any]]:
    """At most so many faces, and their labels (F,), whose borders stay where they are."""
    labels, pairs, edges = _labels_of_faces(mesh)
    light = simplified(mesh, most, edges[labels[pairs[:, 0]] != labels[pairs[:, 1]]])
    return light, labels_near(mesh, labels, light)


def labels_near(mesh: MeshArrays, labels: NDArray[Any], other: MeshArrays) -> NDArray[Any]:
    """Return the labels of the faces of another mesh: those of the nearest faces of this one, which has labels (F,)."""
    return np.asarray(labels[cKDTree(middles(mesh)).query(middles(other))[1]])


def middles(mesh: MeshArrays) -> NDArray[np.float64]:
    """Return the middles (F, 3) of the faces."""
    return mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)


def _labels_of_faces(mesh: MeshArrays) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int64]]:
    """(F,) what most corners of a face are, without small spots; the pairs of faces (E, 2) that share an edge, and
    the edges (E, 2)."""
    of_corners = mesh.labels[mesh.faces]
    labels = np.where(of_corners[:, 1] == of_corners[:, 2], of_corners[:, 1], of_corners[:, 0])
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    order = np.argsort(edges[:, 0] * len(mesh.vertices) + edges[:, 1], kind="stable")
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    pairs = np.stack([order[:-1][same], order[1:][same]], 1) // 3
    for least in (_SPOT // 20, _SPOT // 4, _SPOT):
        at_border = labels[pairs[:, 0]] != labels[pairs[:, 1]]
        spot = components(pairs[~at_border], len(labels))
        is_small = np.bincount(spot) < least
        votes = np.zeros((len(is_small), int(labels.max(initial=0)) + 1), np.int32)
        for a, b in (pairs[at_border].T, pairs[at_border][:, ::-1].T):
            counts = ~is_small[spot[b]]
            np.add.at(votes, (spot[a][counts], labels[b][counts]), 1)
        changed = is_small & (votes.max(axis=1) > 0)
        labels = np.where(changed[spot], votes.argmax(axis=1).astype(labels.dtype)[spot], labels)
    return labels, pairs, edges[order[:-1][same]]


def smoothed_rims(mesh: MeshArrays) -> MeshArrays:
    """The mesh with its open edges in smooth lines in place of the steps of voxels."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
    places = mesh.vertices.astype(np.float64)
    numbers, count = np.unique(edges[:, 0] * len(places) + edges[:, 1], return_counts=True)
    rims = np.stack(np.divmod(numbers[count == 1], len(places)), 1)
    both = np.concatenate([rims, rims[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(places))
    inside = np.flatnonzero(degree == 2)
    for _ in range(_ROUNDS):
        total = np.stack([np.bincount(both[:, 0], places[both[:, 1], k], len(places)) for k in range(3)], 1)
        places[inside] = places[inside] / 2 + total[inside] / 4
    return MeshArrays(places.astype(np.float32), mesh.faces, mesh.colors, mesh.labels)


def simplified(mesh: MeshArrays, most: int, kept: NDArray[np.int64] | None = None) -> MeshArrays:
    """At most so many faces; colour and label are the nearest vertex's. Edges (E, 2) that are `kept` become longer and
    stay in their lines: each has a face upright on it meanwhile, and the quadric of that face."""
    from fast_simplification import simplify

    if len(mesh.faces) <= max(most, _FEWEST):
        return mesh
    fins, tried = np.zeros((0, 3), np.float32), [mesh.faces]
    if kept is not None and len(kept):
        fins = _above(mesh, kept)
        upright = np.column_stack([kept, len(mesh.vertices) + np.arange(len(kept))])
        tried.insert(0, np.concatenate([mesh.faces, upright.astype(np.int32)]))
    points, tree = np.concatenate([mesh.vertices, fins]), cKDTree(np.concatenate([mesh.vertices, fins]))
    for faces in tried:  # where rims and borders keep too much, without these; fewer faces asked for change nothing
        found, made = simplify(points, faces, target_count=max(most, _FEWEST), agg=_SMOOTH)
        found = found.astype(np.float32)
        nearest = tree.query(found)[1]
        made = made[~_are_slivers(found, made) & (nearest[made] < len(mesh.vertices)).all(axis=1)]
        if len(made) <= most:
            break
    if not len(made):
        return mesh  # it has no area at all
    used, renumbered = np.unique(made, return_inverse=True)
    rows = nearest[used]
    return MeshArrays(found[used], renumbered.reshape(-1, 3).astype(np.int32), mesh.colors[rows], mesh.labels[rows])


def _above(mesh: MeshArrays, edges: NDArray[np.int64]) -> NDArray[np.float32]:
    """(E, 3) a place over the middle of each edge, as high as the edge is long."""
    places = mesh.vertices.astype(np.float64)
    first, second = places[edges[:, 0]], places[edges[:, 1]]
    normals = normal_sums(places, mesh.faces)[edges].sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    high = np.linalg.norm(second - first, axis=1, keepdims=True)
    return ((first + second) / 2 + high * normals).astype(np.float32)


def _are_slivers(vertices: NDArray[np.float32], faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return which triangles (F,) are lines: laid flat, one is drawn out over a whole texture."""
    sides = np.linalg.norm(vertices[faces].astype(np.float64) - vertices[np.roll(faces, 1, axis=1)], axis=2)
    return np.asarray(areas(vertices, faces) <= _LINE * sides.max(axis=1) ** 2)


def areas(vertices: NDArray[np.float32], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the areas (F,) of triangles."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
