"""Voxels of the world that gather what all frames saw, and what they tell of a room: up, floor, ceiling, walls and
table tops, from the normals and heights of its surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Intrinsics
from .camera import unproject_depth

if TYPE_CHECKING:
    from .posed_depth import PosedDepth

VOXELS_PER_DEPTH = 60
"""A voxel is this fraction of the scene's median depth: 5 cm at 3 m."""
MIN_WEIGHT = 1.5
"""A voxel of less, one sure pixel and a half, is noise."""
_BITS = 21
_HALF = 1 << (_BITS - 1)
_WAITING = 500_000
"""Voxels of single frames that wait to be summed, at least."""
MAX_VOXELS, _COARSER = 750_000, 2**0.5
"""Voxels, and how much larger they become where a scene has more: half of them are left. They take about 300 bytes each
while they are looked at, by no recording but memory alone."""
_BLOCK = 50_000
"""Voxels whose surroundings are looked at together."""
_OFFSETS = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], np.int64)


@dataclass(frozen=True)
class Voxels:
    """keys (V,) int64 sorted; weight (V,); position, normal (unit) and color (CIE Lab) (V, 3), means over points."""

    size: float
    keys: NDArray[np.int64]
    weight: NDArray[np.float64]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    color: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.keys)


def voxel_keys(points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """(..., 3) points → (...,) keys; equal for points in the same cube. -1 for points too far out to have one."""
    cell = np.floor(points / size)
    inside = np.asarray((np.abs(cell) < _HALF - 2).all(-1))
    cell = np.where(inside[..., None], cell, 0).astype(np.int64) + _HALF
    return np.where(inside, (cell[..., 0] << 2 * _BITS) | (cell[..., 1] << _BITS) | cell[..., 2], -1)


def cells_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(V,) → (V, 3) the cubes that `voxel_keys` are of; sorted keys give sorted cubes."""
    return np.stack([keys >> 2 * _BITS, keys >> _BITS & (1 << _BITS) - 1, keys & (1 << _BITS) - 1], -1) - _HALF


def neighbour_keys(keys: NDArray[np.int64], reach: NDArray[np.int64] = _OFFSETS) -> NDArray[np.int64]:
    """(V,) → (V, R) keys of the cubes around each, in a fixed order."""
    return keys[:, None] + ((reach[:, 0] << 2 * _BITS) + (reach[:, 1] << _BITS) + reach[:, 2])[None]


def find(sorted_keys: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of every key in the sorted keys, -1 where it is not there."""
    if len(sorted_keys) == 0:
        return np.full(keys.shape, -1, np.int64)
    at = np.minimum(np.searchsorted(sorted_keys, keys), len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == keys, at, -1)


def touching(sorted_keys: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Cubes (E,) and (E,) that touch, the first of each two the one with the smaller key; a block at a time, for all 27
    around each of a building's millions need gigabytes."""
    later = _OFFSETS[len(_OFFSETS) // 2 + 1 :]
    found: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []
    for start in range(0, len(sorted_keys), _BLOCK):
        around = find(sorted_keys, neighbour_keys(sorted_keys[start : start + _BLOCK], later))
        a, k = np.nonzero(around >= 0)
        found.append(((a + start).astype(np.int32), around[a, k].astype(np.int32)))
    first, second = zip(*found, strict=True) if found else ((), ())
    return np.concatenate([np.empty(0, np.int32), *first]), np.concatenate([np.empty(0, np.int32), *second])


def find_near(sorted_keys: NDArray[np.int64], keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of `find`, with a neighbouring voxel's where a key is missing; a block of these at a time."""
    flat = keys.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=flat[:1] + 1))  # most pixels show what the one before them does
    runs = flat[starts]
    at = find(sorted_keys, runs)
    lost = np.flatnonzero((at < 0) & (runs >= 0))
    for start in range(0, len(lost), _BLOCK // len(_OFFSETS)):
        block = lost[start : start + _BLOCK // len(_OFFSETS)]
        around = find(sorted_keys, neighbour_keys(runs[block]))
        at[block] = around[np.arange(len(block)), (around >= 0).argmax(1)]
    return np.repeat(at, np.diff(starts, append=len(flat))).reshape(keys.shape)


def normals_in_cam(depth: NDArray[np.float32], intrinsics: Intrinsics) -> NDArray[np.float64]:
    """(h, w, 3) unit normals that face the camera, from central differences; 0 beside unknown depth and at edges."""
    points = unproject_depth(depth, intrinsics)
    along_x = np.zeros_like(points)
    along_y = np.zeros_like(points)
    along_x[:, 1:-1] = points[:, 2:] - points[:, :-2]
    along_y[1:-1] = points[2:] - points[:-2]
    normal = np.cross(along_y, along_x)
    length = np.linalg.norm(normal, axis=-1)
    # Over an occlusion edge the difference spans a gap, not a surface.
    smooth = (np.abs(along_x[..., 2]) < 0.15 * depth) & (np.abs(along_y[..., 2]) < 0.15 * depth)
    known = cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    good = smooth & known & (length > 0)
    normal = np.where(good[..., None], normal / np.maximum(length, 1e-12)[..., None], 0)
    facing = (normal * points).sum(-1, keepdims=True) > 0
    return np.where(facing, -normal, normal)


def to_lab(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w, 3) RGB → CIE Lab."""
    return np.asarray(cv2.cvtColor((image / np.float32(255)).astype(np.float32), cv2.COLOR_RGB2LAB), np.float32)


def gather_frame(
    depth: NDArray[np.float32],
    weight: NDArray[np.float32],
    image: NDArray[np.uint8],
    intrinsics: Intrinsics,
    world_from_cam: NDArray[np.float64],
    size: float,
    given_normals: NDArray[np.int8] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Gather one frame's voxels: keys (V,), and (V, 10) weight and weighted sums of position, normal and Lab colour.

    All images have the size of `intrinsics`. Normals (h, w, 3) in 127ths that a network gave take the place of those
    of the depth where they are known: they do not suffer from its noise.
    """
    points = unproject_depth(depth, intrinsics) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    normals = normals_in_cam(depth, intrinsics)
    if given_normals is not None:
        known = np.abs(given_normals).sum(-1, keepdims=True) > 0
        normals = np.where(known & (np.abs(normals).sum(-1, keepdims=True) > 0), given_normals / 127.0, normals)
    normals = normals @ world_from_cam[:3, :3].T
    lab = to_lab(image)
    use = (depth > 0) & (weight > 0) & (np.abs(normals).sum(-1) > 0)
    keys = voxel_keys(points, size)
    use &= keys >= 0
    w = weight[use].astype(np.float64)
    values = np.concatenate([np.ones((len(w), 1)), points[use], normals[use], lab[use]], axis=1) * w[:, None]
    return _sum_by_key(keys[use], values)


def gather_depths(views: Iterable[PosedDepth], size: float) -> Voxels:
    """Gather the surface that depth images show, by their trust, where they show it well enough; without colours."""

    def gathered(view: PosedDepth) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        black = np.zeros((*view.depth.shape, 3), np.uint8)
        world_from_cam = np.linalg.inv(view.cam_from_world).astype(np.float64)
        return gather_frame(view.depth, view.trust, black, view.intrinsics, world_from_cam, size)

    return merge(size, (gathered(view) for view in views), least=1.0)


def merge(
    size: float,
    frames: Iterable[tuple[NDArray[np.int64], NDArray[np.float64]]],
    limit: int = MAX_VOXELS,
    least: float = 0.0,
) -> Voxels:
    """Merge the frames' voxels, and drop those that no more than the `least` weight speaks for.

    Memory grows with the scene, not with the number of frames; where there are more than `limit`, they grow instead.
    """
    gathered = _Gathered(size, limit, np.empty(0, np.int64), [np.empty(0)] * 10)
    waiting: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
    for row in frames:
        waiting.append(row)
        if sum(len(k) for k, _ in waiting) > max(len(gathered.keys) / 2, _WAITING):
            gathered.add(waiting, size)
            waiting = []
    gathered.add(waiting, size)
    sums, weight = gathered.sums, np.maximum(gathered.sums[0], 1e-12)
    position = np.stack([sums.pop(1) / weight for _ in range(3)], axis=1)
    normal = np.stack([sums.pop(1) for _ in range(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    color = np.stack([sums.pop(1) / weight for _ in range(3)], axis=1)
    voxels = Voxels(gathered.size, gathered.keys, sums[0], position, normal, color)
    return select_voxels(voxels, voxels.weight > least)


@dataclass
class _Gathered:
    """Sorted keys (V,) of cubes of a size, and ten sums (V,) each: weight, position, normal, colour."""

    size: float
    limit: int
    keys: NDArray[np.int64]
    sums: list[NDArray[np.float64]]

    def add(self, rows: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]], size: float) -> None:
        """Rows of frames, in cubes of `size`; one of the sums at a time is there twice."""
        keys = [k if size == self.size else voxel_keys(v[:, 1:4] / v[:, :1], self.size) for k, v in rows]
        self._sum(np.concatenate([self.keys, *keys]), [v for _, v in rows])
        while len(self.keys) > self.limit:
            self.size *= _COARSER
            weight = np.maximum(self.sums[0], 1e-12)
            self._sum(voxel_keys(np.stack([x / weight for x in self.sums[1:4]], axis=1), self.size), [])

    def _sum(self, keys: NDArray[np.int64], more: Sequence[NDArray[np.float64]]) -> None:
        self.keys, place = np.unique(keys, return_inverse=True)
        for c in range(len(self.sums)):
            values = np.concatenate([self.sums[c], *(v[:, c] for v in more)])
            self.sums[c] = np.asarray(np.bincount(place, weights=values, minlength=len(self.keys)), np.float64)


def select_voxels(voxels: Voxels, keep: NDArray[np.bool_]) -> Voxels:
    """Keep the voxels where `keep` (V,) is true."""
    return Voxels(
        voxels.size,
        voxels.keys[keep],
        voxels.weight[keep],
        voxels.position[keep],
        voxels.normal[keep],
        voxels.color[keep],
    )


def _sum_by_key(keys: NDArray[np.int64], values: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    unique, place = np.unique(keys, return_inverse=True)
    columns = [np.bincount(place, weights=values[:, c], minlength=len(unique)) for c in range(values.shape[1])]
    return unique, np.stack(columns, axis=1)


# layout of a room ------------------------------------------------------------------------------------------------

OTHER, FLOOR, CEILING, WALL, SURFACE = range(5)

_HORIZONTAL = np.cos(np.radians(25))
_VERTICAL = np.sin(np.radians(20))
_MIN_SHARE = 0.015
"""A plane with a smaller share of all surface is not named."""
_BEYOND_SHARE = 0.03
"""Behind a wall, under a floor, over a ceiling there is at most this share of the surface."""


_LEANING = 0.03
"""How much the cameras' up counts beside walls that are all of the surface; a third and three times that do as well."""


@dataclass(frozen=True)
class Gravity:
    """up (3,) unit vector in the world; `is_sure` when a dominant plane confirms the cameras' own up."""

    up: NDArray[np.float64]
    is_sure: bool


def find_gravity(voxels: Voxels, cam_up: NDArray[np.float64]) -> Gravity:
    """Find up: the normal direction of the most surface within 40° of the cameras' mean up `cam_up` (people hold
    cameras upright). Opposite normals (floor and ceiling) count as the same direction. Without much surface there:
    what the walls stand along, or the cameras' up, unsure."""
    cam_up = cam_up / max(float(np.linalg.norm(cam_up)), 1e-12)
    along = voxels.normal @ cam_up
    near = np.abs(along) > np.cos(np.radians(40))
    if voxels.weight[near].sum() <= 0.03 * voxels.weight.sum():
        return Gravity(_along_walls(voxels, cam_up), False)
    normals = voxels.normal[near] * np.sign(along[near])[:, None]
    weight = voxels.weight[near]
    up = normals[int(_support(normals, weight).argmax())]
    for _ in range(5):
        close = normals @ up > np.cos(np.radians(8))
        up = (normals[close] * weight[close, None]).sum(0)
        up = up / np.linalg.norm(up)
    share = weight[normals @ up > np.cos(np.radians(8))].sum() / voxels.weight.sum()
    return Gravity(up, True) if share > 2 * _MIN_SHARE else Gravity(_along_walls(voxels, cam_up), False)


def _along_walls(voxels: Voxels, up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction across the normals of what stands, near `up`, which decides where all walls face one way."""
    for degrees in (40, 30, 20):
        weight = voxels.weight * (np.abs(voxels.normal @ up) < np.sin(np.radians(degrees)))
        spread = (voxels.normal.T * weight) @ voxels.normal / max(float(voxels.weight.sum()), 1e-12)
        up = np.linalg.solve(spread + _LEANING * np.eye(3), _LEANING * up)
        up = up / max(float(np.linalg.norm(up)), 1e-12)
    return np.asarray(up)


def _support(normals: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight within 8° of a sample of the normals; 0 for those not sampled."""
    support = np.zeros(len(normals))
    for i in np.linspace(0, len(normals) - 1, min(len(normals), 400)).astype(np.int64):
        support[i] = weight[normals @ normals[i] > np.cos(np.radians(8))].sum()
    return support


def name_structure(voxels: Voxels, gravity: Gravity, cameras: NDArray[np.float64]) -> NDArray[np.int64]:
    """(V,) OTHER, FLOOR, CEILING, WALL or SURFACE of every voxel; `cameras` (N, 3) are the camera centres."""
    kind = np.full(len(voxels), OTHER, np.int64)
    if not gravity.is_sure:
        return kind
    height = voxels.position @ gravity.up
    upward = voxels.normal @ gravity.up
    eye = float(np.median(cameras @ gravity.up))
    thick = 2.5 * voxels.size
    share = voxels.weight / voxels.weight.sum()
    for level in levels(height, share * (upward > _HORIZONTAL), voxels.size):
        members = (upward > _HORIZONTAL) & (np.abs(height - level) < thick)
        is_lowest = share[height < level - 2 * thick].sum() < _BEYOND_SHARE
        kind[members & (kind == OTHER)] = FLOOR if is_lowest and level < eye else SURFACE
    for level in levels(height, share * (upward < -_HORIZONTAL), voxels.size):
        members = (upward < -_HORIZONTAL) & (np.abs(height - level) < thick)
        if share[height > level + 2 * thick].sum() < _BEYOND_SHARE and level > eye:
            kind[members] = CEILING
    _name_walls(voxels, gravity.up, share, upward, kind)
    return kind


@dataclass(frozen=True)
class FloorPlane:
    """`normal` (3,) unit vector upwards, and a `point` (3,) of the floor or the ceiling, in the world."""

    normal: NDArray[np.float64]
    point: NDArray[np.float64]


def floor_plane(
    voxels: Voxels, kinds: NDArray[np.int64], up: NDArray[np.float64], kind: int = FLOOR
) -> FloorPlane | None:
    """Fit the plane of the voxels that `name_structure` called floor (or CEILING, for `kind`); None without any.

    Up by normals is good to a degree or two, which is centimetres at the feet: the floor's own plane is exact.
    """
    floor, share = voxels.position[kinds == kind], voxels.weight[kinds == kind]
    if len(floor) < 3:
        return None
    weight = share
    for _ in range(5):
        middle = np.average(floor, 0, weight)
        normal = np.linalg.eigh((floor - middle).T @ ((floor - middle) * weight[:, None]))[1][:, 0]
        normal *= np.sign(normal @ up)
        off = np.abs((floor - middle) @ normal)
        weight = share / (1 + (off / (np.median(off) + 1e-12)) ** 2)
    return FloorPlane(normal, middle)


def levels(
    value: NDArray[np.float64], share: NDArray[np.float64], size: float, least: float = _MIN_SHARE
) -> list[float]:
    """Peaks of a histogram of `value` weighted by `share`, largest first, each with at least the share `least`."""
    if share.sum() < least:
        return []
    low = value.min() - 4 * size
    bins = np.bincount(((value - low) / size).astype(np.int64), weights=share)
    smooth = np.convolve(bins, np.ones(5), mode="same")
    found = []
    while smooth.max() >= least:
        peak = int(smooth.argmax())
        span = slice(max(peak - 2, 0), peak + 3)
        center = (np.arange(len(bins))[span] * bins[span]).sum() / bins[span].sum()
        found.append(float(low + (center + 0.5) * size))
        bins[max(peak - 4, 0) : peak + 5] = 0
        smooth = np.convolve(bins, np.ones(5), mode="same")
    return found


def _name_walls(
    voxels: Voxels,
    up: NDArray[np.float64],
    share: NDArray[np.float64],
    upward: NDArray[np.float64],
    kind: NDArray[np.int64],
) -> None:
    """Vertical planes with much surface and almost nothing behind them."""
    upright = (np.abs(upward) < _VERTICAL) & (kind == OTHER)
    left = upright.copy()
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    for _ in range(12):
        azimuth = np.arctan2(voxels.normal @ second, voxels.normal @ first)
        bins = np.bincount(((azimuth[left] + np.pi) / (2 * np.pi) * 72).astype(np.int64) % 72, share[left], 72)
        smooth = bins + np.roll(bins, 1) + np.roll(bins, -1)
        if smooth.max() < _MIN_SHARE:
            return
        angle = (int(smooth.argmax()) + 0.5) / 72 * 2 * np.pi - np.pi
        facing = left & (np.cos(azimuth - angle) > np.cos(np.radians(12)))
        normal = (voxels.normal[facing] * share[facing, None]).sum(0)
        normal -= up * (normal @ up)
        normal /= np.linalg.norm(normal)
        offset = voxels.position @ normal
        for level in levels(offset, share * facing, voxels.size):
            plane = facing & (np.abs(offset - level) < 2.5 * voxels.size)
            if share[offset < level - 5 * voxels.size].sum() < _BEYOND_SHARE:
                kind[plane] = WALL
        left &= ~facing
