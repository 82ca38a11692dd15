"""Planes of what is surely seen: uncertain depths move onto them, and they go on where nothing is seen.

Planes are found by random hypotheses, largest first, and fitted again to what lies on them (RANSAC, Fischler and Bolles
1981).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ..geometry.camera import resample_nearest, unproject_depth
from ..geometry.posed_depth import PosedDepth
from ..geometry.voxels import (
    VOXELS_PER_DEPTH,
    Voxels,
    cells_of,
    find,
    gather_depths,
    neighbour_keys,
    normals_in_cam,
    voxel_keys,
)
from ..mapping.measure import MeshView
from ..run.outcome import spread_sample
from ..types import Array
from .volume import SIDE, Volume

_SIDE = 200
_COMPARED = 24
"""Views whose median depth sets the size of a voxel."""
_STRETCH = 1.4
"""A depth changes by no larger factor: a plane seen from the side is far away a little beside."""

_MAX_PLANES, _MIN_SHARE, _MIN_VOXELS = 20, 0.01, 30
"""Planes, and the share of the sure surface and the voxels that each has at least."""
_HYPOTHESES, _COUNTED = 200, 20_000
"""Planes through a voxel that are tried for each that is found, and voxels by which they are compared."""
_THICK, _TAKEN = 0.7, 2.0
"""Voxels from a plane: up to the first a voxel lies on it, up to the second it is in no further plane."""
_ALONG, ROUGHLY_ALONG = 0.94, 0.8
"""Cosine between the normals of a plane and of a voxel that lies on it, and of a pixel that moves onto it."""
REACH = 3.0
"""Voxels that a depth moves at most, across the plane."""
NEAR, _AGREE = 8, 0.25
"""A plane is believed in cubes of so many voxels where it has this share of all that lies within reach and along it,
and in those without any that touch them: not where a sure surface bends away from it or has a step."""
CELL = 2.0
"""Voxels along a side of the squares of a plane in which it goes on, or does not."""
_ENDS = 0.9
"""A plane ends at another that stands on it where this share of the other is on the side of the cameras."""
_STANDS = 0.3
"""Cosine between the normals of planes of which one stands on the other."""
_AT_ONCE = 500
"""Blocks of the volume that are completed together."""


@dataclass(frozen=True)
class Planes:
    """normal (P, 3) unit vectors towards the cameras; offset (P,) = normal @ point; `cubes`, of each the sorted keys of
    the cubes of side `NEAR * voxel` where it is believed."""

    voxel: float
    normal: Array
    offset: Array
    cubes: Sequence[NDArray[np.int64]]
    axes: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    squares: Sequence[NDArray[np.int64]] = ()

    def keys(self, number: int, points: Array) -> NDArray[np.int64]:
        """Keys of the squares of a plane that points (..., 3) lie in."""
        along = points @ self.axes[number].T
        return voxel_keys(np.concatenate([along, np.zeros((*along.shape[:-1], 1))], axis=-1), CELL * self.voxel)

    def points(self, aside: float) -> Array:
        """(N, 3) the middles of all squares where planes go on, and what lies `aside` on either side of them."""
        found = [np.zeros((0, 3))]
        for normal, offset, axes, squares in zip(self.normal, self.offset, self.axes, self.squares, strict=False):
            middles = (cells_of(squares)[:, :2] + 0.5) * (CELL * self.voxel) @ axes + offset * normal
            found += [middles + side * aside * normal for side in (-1, 0, 1)]
        return np.concatenate(found)


def find_planes(voxels: Voxels) -> Planes:
    """The largest planes of a surface; the same ones every time."""
    rng, left, total = np.random.default_rng(0), np.ones(len(voxels), bool), voxels.weight.sum()
    normals, offsets, cubes = [], [], []
    for _ in range(_MAX_PLANES):
        if left.sum() < _MIN_VOXELS:
            break
        on = _largest(voxels, np.flatnonzero(left), rng)
        if voxels.weight[on].sum() < _MIN_SHARE * total or len(on) < _MIN_VOXELS:
            break
        normal, offset, on = _fitted(voxels, left, on)
        left &= ~_on(voxels, normal, offset, _TAKEN, ROUGHLY_ALONG)
        left[on] = False
        if len(on) >= _MIN_VOXELS:
            normals.append(normal)
            offsets.append(offset)
            cubes.append(_believed(voxels, normal, offset, on))
    return Planes(float(voxels.size), np.array(normals).reshape(-1, 3), np.array(offsets), cubes)


def _largest(voxels: Voxels, left: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
    """The voxels on the best of some planes through a voxel; voxels are drawn by their weight."""
    share = voxels.weight[left] / voxels.weight[left].sum()
    tried = rng.choice(left, min(_HYPOTHESES, len(left)), replace=False, p=share)
    seen = left if len(left) <= _COUNTED else rng.choice(left, _COUNTED, replace=False)
    normal = voxels.normal[tried]
    offset = (voxels.position[tried] * normal).sum(1)
    on = np.abs(voxels.position[seen] @ normal.T - offset) < _THICK * voxels.size
    on &= voxels.normal[seen] @ normal.T > _ALONG
    best = int((voxels.weight[seen] @ on).argmax())
    return left[_on(voxels, normal[best], offset[best], _THICK, _ALONG)[left]]


def _fitted(voxels: Voxels, left: NDArray[np.bool_], on: NDArray[np.int64]) -> tuple[Array, float, NDArray[np.int64]]:
    """Normal, offset and voxels of the plane through the middle of the voxels `on`, and of those that it then has."""
    for _ in range(3):
        weight = voxels.weight[on]
        middle = np.average(voxels.position[on], 0, weight)
        apart = voxels.position[on] - middle
        normal = np.linalg.eigh((apart * weight[:, None]).T @ apart)[1][:, 0]
        normal = normal * (1 if (voxels.normal[on] @ normal).sum() > 0 else -1)
        offset = float(middle @ normal)
        on = np.flatnonzero(left & _on(voxels, normal, offset, _THICK, _ALONG))
        if len(on) < _MIN_VOXELS:
            break
    return normal, offset, on


def _believed(voxels: Voxels, normal: Array, offset: float, on: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted keys of the cubes where what lies `on` the plane is not outweighed."""
    near = _on(voxels, normal, offset, REACH, ROUGHLY_ALONG)
    near[on] = True
    keys, place = np.unique(voxel_keys(voxels.position[near], NEAR * voxels.size), return_inverse=True)
    weight = voxels.weight[near]
    agrees = np.bincount(place, weight * np.isin(np.flatnonzero(near), on)) >= _AGREE * np.bincount(place, weight)
    return np.setdiff1d(neighbour_keys(keys[agrees]), keys[~agrees])


def _on(voxels: Voxels, normal: Array, offset: float, within: float, along: float) -> NDArray[np.bool_]:
    close = np.abs(voxels.position @ normal - offset) < within * voxels.size
    return np.asarray(close & (voxels.normal @ normal > along))


def planes_of(views: Sequence[MeshView]) -> Planes:
    """The planes of what the views surely show."""
    some = (views[n].shown for n in spread_sample(range(len(views)), _COMPARED))
    seen = [float(np.median(v.depth[v.trust > 0])) for v in some if (v.trust > 0).any()]
    size = float(np.median(seen)) / VOXELS_PER_DEPTH if seen else 1.0
    voxels = gather_depths((_sure_part(view) for view in views), size)
    return extended(find_planes(voxels), voxels)


def extended(planes: Planes, voxels: Voxels) -> Planes:
    """With the squares where each plane goes on: between what is seen of it, and up to where it ends."""
    planes = replace(planes, axes=np.array([_axes(planes, n) for n in planes.normal]).reshape(-1, 2, 3))
    return replace(planes, squares=[_squares(planes, number, voxels) for number in range(len(planes.offset))])


def _axes(planes: Planes, normal: Array) -> Array:
    """(2, 3) along the plane, the first along the largest plane that stands on it."""
    across = np.abs(planes.normal @ normal)
    other = planes.normal[int((across < 0.5).argmax())] if (across < 0.5).any() else np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, other) / np.linalg.norm(np.cross(normal, other))
    return np.stack([first, np.cross(normal, first)])


def _squares(planes: Planes, number: int, voxels: Voxels) -> NDArray[np.int64]:
    """Sorted keys of the squares that voxels of the plane lie in or beside, or that lie between such ones, or such ones
    and where it ends."""
    normal, offset = planes.normal[number], planes.offset[number]
    places = [voxels.position[_on(voxels, normal, offset, _THICK, _ALONG)]]
    for other, at in zip(planes.normal, planes.offset, strict=True):
        along = normal - (normal @ other) * other
        if np.abs(normal @ other) < _STANDS:
            points = voxels.position[_on(voxels, other, at, _THICK, _ALONG)]
            height = points @ normal - offset
            if (height > -_TAKEN * voxels.size).mean() > _ENDS:
                places.append(points - (height / (normal @ along))[:, None] * along)
    found = [np.unique(planes.keys(number, points)) for points in (places[0], np.concatenate(places))]
    own, walls = (cells_of(keys[keys >= 0])[:, :2] for keys in found)
    if len(own) == 0:
        return np.zeros(0, np.int64)
    low = walls.min(0) - 1
    size = walls.max(0) - low + 2
    seen, wall = np.zeros((2, *size), bool)
    seen[tuple((own - low).T)] = True
    wall[tuple((walls - low).T)] = True
    seen = binary_dilation(seen, np.ones((3, 3)))
    wall |= seen
    (left, right, up, down), ends = _sides(seen), _sides(wall)
    goes_on = seen | ((left | right) & ends[0] & ends[1]) | ((up | down) & ends[2] & ends[3])
    middles = (np.argwhere(goes_on) + low + 0.5) * (CELL * planes.voxel)
    return np.sort(voxel_keys(np.column_stack([middles, np.zeros(len(middles))]), CELL * planes.voxel))


def _sides(seen: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Whether anything is seen from a square to each of the four sides."""
    turned = (seen, seen[::-1], seen.T, seen.T[::-1])
    left, right, up, down = (np.logical_or.accumulate(t, axis=0) for t in turned)
    return [left, right[::-1], up.T, down[::-1].T]


def put_planes(volume: Volume, planes: Planes, truncation: float, least: float) -> None:
    """Put planes where they go on and the volume has less than the `least` weight, with so much, in place."""
    centers, steps = (volume.blocks + 0.5) * (volume.voxel * SIDE), np.arange(SIDE)
    inside = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1) * volume.voxel
    for number, squares in enumerate(planes.squares):
        normal, offset = planes.normal[number], planes.offset[number]
        near = np.abs(centers @ normal - offset) < truncation + SIDE * volume.voxel
        for start in range(0, int(near.sum()), _AT_ONCE):
            rows = np.flatnonzero(near)[start : start + _AT_ONCE]
            points = volume.blocks[rows, None, None, None] * (volume.voxel * SIDE) + inside
            distance = (points @ normal - offset) / truncation
            new = (np.abs(distance) < 1) & (volume.weight[rows] < least)
            new &= find(squares, planes.keys(number, points)) >= 0
            volume.distance[rows] = np.where(new, distance, volume.distance[rows])
            volume.weight[rows] = np.where(new, least, volume.weight[rows])


def _sure_part(view: MeshView) -> PosedDepth:
    shown, small = view.shown, view.shown.intrinsics.at_most(_SIDE)
    trust = shown.trust if view.unsure is None else np.where(view.unsure, 0, shown.trust).astype(np.float32)
    depth, trust = (resample_nearest(x, small.height, small.width) for x in (shown.depth, trust))
    return PosedDepth(small, shown.cam_from_world, depth, trust)


def snap_to_planes(view: MeshView, planes: Planes) -> MeshView:
    """Put its uncertain depths on the nearest plane that they lie along, along their rays; `unsure` is None then."""
    if view.unsure is None:
        return view
    shown = view.shown
    pixels = np.flatnonzero(view.unsure & (shown.depth > 0) & (shown.trust > 0))
    world_from_cam = np.linalg.inv(shown.cam_from_world)
    rays = unproject_depth(shown.depth, shown.intrinsics).reshape(-1, 3)[pixels] @ world_from_cam[:3, :3].T
    normals = _normals(shown).reshape(-1, 3)[pixels] @ world_from_cam[:3, :3].T
    factor, moved = np.ones(len(pixels)), np.full(len(pixels), REACH * planes.voxel)
    eye = world_from_cam[:3, 3]
    for normal, offset, cubes in zip(planes.normal, planes.offset, planes.cubes, strict=True):
        height, along = float(normal @ eye - offset), rays @ normal
        off = np.abs(height + along)
        fits = np.flatnonzero((off < moved) & (normals @ normal > ROUGHLY_ALONG) & (along < 0) & (height > 0))
        to = -height / along[fits]
        keys = voxel_keys(eye + to[:, None] * rays[fits], NEAR * planes.voxel)
        good = (np.maximum(to, 1 / to) < _STRETCH) & (find(cubes, keys) >= 0)
        factor[fits[good]], moved[fits[good]] = to[good], off[fits[good]]
    depth = shown.depth.copy()
    depth.ravel()[pixels] *= factor.astype(np.float32)
    return replace(view, shown=replace(shown, depth=depth), unsure=None)


def _normals(shown: PosedDepth) -> NDArray[np.float64]:
    """(H, W, 3) in the camera, over some pixels: a depth's noise tilts those between neighbours."""
    camera = shown.intrinsics
    small = camera.at_most(_SIDE)
    coarse = normals_in_cam(resample_nearest(shown.depth, small.height, small.width), small)
    return resample_nearest(coarse, camera.height, camera.width)
