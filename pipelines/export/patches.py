"""Patches over slits and holes of the lighter mesh, at the depths that keyframes have there."""

from collections.abc import Sequence
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from scipy.spatial import cKDTree

from ...formats.ply import MeshArrays
from ..geometry.posed_depth import PosedDepth
from ..system.raster import draw_faces

_ACROSS, _COARSER = 320, (1, 2, 4)
"""Pixels of a view's longer side that patches are made in, and how many times coarser ones."""
_SLIT, _SAME_SIDE, _OVER = 1 / 32, 0.03, 0.75
"""How wide a slit is in such sides, the part by which depths differ at most that are one patch, and how many pixels
patches reach over the rim of what is missing."""
_VIEWS = 400
"""About as many are asked for patches; of a longer recording every second or third."""


def patched(mesh: MeshArrays, views: Sequence[PosedDepth], most: int) -> MeshArrays:
    """Cover what views see in slits and holes of the mesh: a square a pixel, at the depth that the view knows there,
    of coarser pixels where there would be more than `most` faces in all, as many as there may be of the coarsest.

    What an earlier view has covered is covered for the later ones; it is looked at again, for what those may have
    enclosed. Corners between pixels of nearly one depth are common to their squares, and at a step of the depth none:
    nothing reaches from what is near to what is behind it.
    """
    made = mesh
    for coarser in _COARSER if len(mesh.faces) else ():
        made, is_whole = _patched(mesh, views, most, coarser)
        if is_whole:
            break
    return made


def _patched(mesh: MeshArrays, views: Sequence[PosedDepth], most: int, coarser: int) -> tuple[MeshArrays, bool]:
    """With pixels so many times coarser; and whether that are all patches."""
    vertices, faces, colors, labels = mesh.vertices, mesh.faces, mesh.colors, mesh.labels
    tree, is_whole = cKDTree(vertices), True
    some = range(0, len(views), -(-len(views) // _VIEWS) or 1)
    for view in (views[n] for n in chain(some, some)):
        stride = coarser * -(-max(view.depth.shape) // _ACROSS)
        depth, camera = view.depth[stride // 2 :: stride, stride // 2 :: stride], view.intrinsics.every(stride)
        drawn = draw_faces(vertices, faces, view.cam_from_world, camera).depth
        missing = _is_enclosed(drawn > 0, 1 + 2 * round(_SLIT * max(depth.shape) / 2)) & (depth > 0)
        if not missing.any():
            continue
        xy, z, corners = _squares(missing, np.where(drawn > 0, drawn, depth).astype(np.float64))
        if len(faces) + len(corners) > most:
            is_whole = False
            if coarser < _COARSER[-1]:
                break
            continue
        seen = PosedDepth(camera, view.cam_from_world, depth, depth)
        new, count = seen.in_world(xy, z).astype(np.float32), np.int32(len(vertices))
        nearest = tree.query(new)[1]
        vertices, faces = np.concatenate([vertices, new]), np.concatenate([faces, corners + count])
        colors, labels = (np.concatenate([values, values[nearest]]) for values in (colors, labels))
    return MeshArrays(vertices, faces, colors, labels), is_whole


def _is_enclosed(covered: NDArray[np.bool_], wide: int) -> NDArray[np.bool_]:
    """(H, W) what is not covered in slits, up to so many pixels wide, and holes of what is."""
    ball = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    padded = np.pad(covered.astype(np.uint8), wide, mode="edge")
    near = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, ball)[wide:-wide, wide:-wide] > 0
    return np.asarray(binary_fill_holes(near | covered) & ~covered)


def _squares(
    wanted: NDArray[np.bool_], depth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Two triangles (F, 3) for each wanted pixel (H, W), of corners at xy (C, 2) with z (C,): the harmonic mean of
    those of the four pixels there that are about as far away. Corners on the rim lie `_OVER` beyond it."""
    row, column = np.nonzero(wanted)
    own, around, inside = depth[row, column], np.pad(depth, 1), np.pad(wanted, 1).astype(np.int64)
    out = [np.sign(np.diff(inside[:, 1:] + inside[:, :-1], axis=0)), np.sign(np.diff(inside[1:] + inside[:-1], axis=1))]
    corners, places = [], []
    for down, right in ((0, 0), (1, 0), (1, 1), (0, 1)):
        neighbours = np.stack([around[row + down + a, column + right + b] for a in (0, 1) for b in (0, 1)])
        alike = (np.abs(neighbours - own) <= _SAME_SIDE * own) & (neighbours > 0)
        corners.append(alike.sum(0) / np.where(alike, 1 / np.maximum(neighbours, 1e-300), 0).sum(0))
        places.append((row + down) * (depth.shape[1] + 1) + column + right)
    keys = np.stack([np.concatenate(places).astype(np.float64), np.concatenate(corners)], 1)
    unique, number = np.unique(keys, axis=0, return_inverse=True)
    a, b, c, d = number.reshape(4, -1).astype(np.int32)
    y, x = np.divmod(unique[:, 0].astype(np.int64), depth.shape[1] + 1)
    at = np.stack([x - _OVER * out[1][y, x], y - _OVER * out[0][y, x]], 1)
    return at, unique[:, 1], np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
