"""A lighter mesh and a flat image of its surface: quadric simplification, charts, and who owns which texel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ....formats.mesh import MeshArrays
from ...system.jit import kernel

SHARE = 0.1
"""Vertices that are kept: with a texture they need to follow the shape only."""
_FEWEST = 4
"""Faces that a mesh is not simplified below."""
_SMOOTH = 5.0
"""How readily fast-simplification goes on to worse edges (its `agg`; lower is slower and keeps the shape better)."""
_GUTTER = 2
"""Empty texels around a chart, beyond those that bilinear sampling reaches."""
_PART = 4000
"""Faces that are cut into charts together: the time for it grows faster than their number (11 s for the 35,000 of
whiteroom at once, 5 s in parts)."""
_FILLED = 0.7
"""The part of the square that charts of rooms fill (kitchen 0.70, whiteroom 0.75)."""


@dataclass(frozen=True)
class Atlas:
    """A mesh whose corners lie in an image too.

    corners (K, 2) float64 texels, the first texel's centre at (0.5, 0.5), and corner_vertex (K,) the vertex of each;
    corner_faces (F, 3) are the faces in corners; width and height in texels.
    """

    mesh: MeshArrays
    corners: NDArray[np.float64]
    corner_vertex: NDArray[np.int64]
    corner_faces: NDArray[np.int32]
    width: int
    height: int


def simplified(mesh: MeshArrays, share: float = SHARE) -> MeshArrays:
    """At most that share of the vertices (Garland and Heckbert 1997), down to four faces; colour and label are the
    nearest vertex's."""
    from fast_simplification import simplify

    most, wanted = share * len(mesh.vertices), share * len(mesh.faces)
    if len(mesh.faces) <= _FEWEST:
        return mesh
    for _ in range(3):  # along open rims there are more vertices to a face than elsewhere
        points, faces = simplify(mesh.vertices, mesh.faces, target_count=max(int(wanted), _FEWEST), agg=_SMOOTH)
        points = points.astype(np.float32)
        used, renumbered = np.unique(faces[_areas(points, faces) > 0], return_inverse=True)
        if len(used) == 0:
            return mesh  # it has no area at all
        if len(used) <= most:
            break
        wanted *= 0.99 * most / len(used)
    _, nearest = cKDTree(mesh.vertices).query(points[used])
    return MeshArrays(
        points[used], renumbered.reshape(-1, 3).astype(np.int32), mesh.colors[nearest], mesh.labels[nearest]
    )


def unwrapped(mesh: MeshArrays, texels_per_unit: float, most: int) -> Atlas:
    """The mesh cut into charts that lie flat beside each other, in an image of at most that many texels a side."""
    import xatlas

    # xatlas takes faces for nothing whose area is below 1e-7, whatever the unit: with this one they are 1 on the whole.
    scale = np.float32(1 / np.sqrt(_areas(mesh.vertices, mesh.faces).mean().clip(1e-30)))
    square = float(np.sqrt(len(mesh.faces) / _FILLED))
    packing = xatlas.PackOptions()
    packing.texels_per_unit, packing.padding = min(texels_per_unit / float(scale), 0.97 * most / square), _GUTTER
    atlas, parts = xatlas.Atlas(), _parts(mesh)
    vertices_of = [np.unique(mesh.faces[part], return_inverse=True) for part in parts]
    for used, renumbered in vertices_of:
        atlas.add_mesh(scale * mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.uint32))
    atlas.generate(pack_options=packing)
    pieces = [atlas[i] for i in range(len(parts))]
    vertex = np.concatenate([used[own] for (used, _), (own, _, _) in zip(vertices_of, pieces, strict=True)])
    firsts = np.cumsum([0, *(len(own) for own, _, _ in pieces)])
    faces = np.empty_like(mesh.faces)
    for part, first, (_, of_part, _) in zip(parts, firsts, pieces, strict=False):
        faces[part] = of_part + first
    uv = np.concatenate([of_part for _, _, of_part in pieces])
    # How well charts fill a square is known afterwards only.
    shrunk = min(most / max(atlas.width, atlas.height, 1), 1.0)
    width, height = max(int(atlas.width * shrunk), 1), max(int(atlas.height * shrunk), 1)
    corners = uv * np.array([width, height], np.float64)
    return Atlas(mesh, corners, vertex.astype(np.int64), faces, width, height)


def _parts(mesh: MeshArrays) -> list[NDArray[np.int64]]:
    """The faces (by number) in boxes of at most `_PART`, halved along their longest side."""
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    waiting, parts = [np.arange(len(mesh.faces))], []
    while waiting:
        part = waiting.pop()
        if len(part) <= _PART:
            parts.append(np.sort(part))
            continue
        along = part[np.argsort(middles[part][:, np.ptp(middles[part], axis=0).argmax()], kind="stable")]
        waiting += [along[len(part) // 2 :], along[: len(part) // 2]]
    return parts


def _areas(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def owners(atlas: Atlas) -> NDArray[np.int32]:
    """(height, width) the face that each texel lies in, or next to within a texel and a half; -1 = none."""
    owner = np.full((atlas.height, atlas.width), -1, np.int32)
    for reach in (0.0, 1.5):
        _own(atlas.corners, atlas.corner_faces, owner, reach)
    return owner


@kernel
def _own(corners, faces, owner, reach):  # type: ignore[no-untyped-def]
    height, width = owner.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = corners[a, 0], corners[a, 1]
        bx, by = corners[b, 0], corners[b, 1]
        cx, cy = corners[c, 0], corners[c, 1]
        twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if twice == 0:
            continue
        # Distances from the sides in texels, positive inside.
        sign = 1.0 if twice > 0 else -1.0
        ab = sign / max(np.hypot(bx - ax, by - ay), 1e-9)
        bc = sign / max(np.hypot(cx - bx, cy - by), 1e-9)
        ca = sign / max(np.hypot(ax - cx, ay - cy), 1e-9)
        first_row = max(int(min(ay, by, cy) - reach), 0)
        last_row = min(int(max(ay, by, cy) + reach), height - 1)
        first_column = max(int(min(ax, bx, cx) - reach), 0)
        last_column = min(int(max(ax, bx, cx) + reach), width - 1)
        for row in range(first_row, last_row + 1):
            y = row + 0.5
            for column in range(first_column, last_column + 1):
                x = column + 0.5
                if (
                    owner[row, column] < 0
                    and ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * ab >= -reach
                    and ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * bc >= -reach
                    and ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * ca >= -reach
                ):
                    owner[row, column] = f
