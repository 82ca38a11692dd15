"""Regions of the reconstructed scene: all frames' depths are gathered in one grid of voxels, and the grid is cut into
parts and patches (graph-based segmentation, Felzenszwalb and Huttenlocher, IJCV 2004)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..depth.completion.fill import domain_transform_in_place
from ..geometry.camera import resample_nearest
from ..geometry.sequence import Sequence
from ..geometry.voxels import (
    MIN_WEIGHT,
    VOXELS_PER_DEPTH,
    Gravity,
    Voxels,
    find_gravity,
    floor_plane,
    gather_frame,
    merge,
    name_structure,
    touching,
)
from ..providers import DepthEstimate, LabelEstimate
from ..system.jit import kernel
from ..system.machine import release_free_memory
from ..system.progress import Progress
from ..types import VOID, Frame

_COLOR_UNIT = 12.0
"""Difference in CIE Lab that counts as much as a right angle between the normals."""
_BLOCK = 500_000
"""Edges that are weighed together."""
_SCALE = 20.0
_PATCH_SCALE = 3.0
"""Of 1 to 20 that which, with the votes of a network averaged in each patch, named rooms best (two recordings)."""

_GATHER_SIDE = 200
_MIN_CONFIDENCE = 0.2
_REACH = 40.0
_COLOR_SD = 40.0
_MIN_VOTE = 1e-3


class Segments:
    """The surface that all frames with a pose show together."""

    def __init__(self, sequence: Sequence, progress: Progress) -> None:
        """Raises InputError without a backbone."""
        if not sequence.cam_from_world:
            raise InputError(
                "regions of the scene need camera poses, and structure from motion found none: the camera stands still "
                "or only turns. Move it sideways, or give classes with --semantics files:FOLDER or onnx:CARD"
            )
        self.sequence, self._progress = sequence, progress
        self._size = 1.0
        self._world_from_cam = {k: np.linalg.inv(v).astype(np.float64) for k, v in sequence.cam_from_world.items()}

    def structure(
        self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]
    ) -> tuple[Voxels, Gravity, NDArray[np.int64]]:
        """All frames' surface in voxels (V,), gravity, and floor, ceiling, wall, surface or other (V,)."""
        posed = [f for f in frames if f.id in self._world_from_cam]
        self._size = _scene_depth([depth_of(f) for f in posed[:: max(1, len(posed) // 12)]]) / VOXELS_PER_DEPTH
        release_free_memory()  # what depths and moving things have needed
        tracked = self._progress.track(posed, "regions", len(posed))
        voxels = merge(self._size, (self._gather(f, depth_of(f)) for f in tracked), least=MIN_WEIGHT)
        self._size = voxels.size
        cameras = np.array([self._world_from_cam[f.id] for f in posed])
        gravity = find_gravity(voxels, -cameras[:, :3, 1].mean(0))
        return voxels, gravity, name_structure(voxels, gravity, cameras[:, :3, 3])

    def heights(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> NDArray[np.float64]:
        """(N,) height of each posed camera over the floor, in the unit of the depth; (0,) without a sure floor."""
        voxels, gravity, kind = self.structure(frames, depth_of)
        floor = floor_plane(voxels, kind, gravity.up)
        if floor is None:
            return np.empty(0)
        centres = np.array([self._world_from_cam[f.id][:3, 3] for f in frames if f.id in self._world_from_cam])
        return np.asarray((centres - floor.point) @ floor.normal)

    def _gather(self, frame: Frame, estimate: DepthEstimate) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        small = self.sequence.intrinsics.at_most(_GATHER_SIDE)
        confidence = resample_nearest(estimate.confidence, small.height, small.width)
        return gather_frame(
            resample_nearest(estimate.depth, small.height, small.width),
            np.where(confidence >= _MIN_CONFIDENCE, confidence, 0).astype(np.float32),
            resample_nearest(self.sequence.image(frame), small.height, small.width),
            small,
            self._world_from_cam[frame.id],
            self._size,
            None if estimate.normals is None else resample_nearest(estimate.normals, small.height, small.width),
        )


def label_pixels(votes: NDArray[np.float32], trust: NDArray[np.float32], image: NDArray[np.uint8]) -> LabelEstimate:
    """Labels (h, w) from votes (h, w, C) that count by the `trust` (h, w) in the place they are of, spread along like
    colours of the image to where it is low; VOID where nothing is known from near or far. The votes are spread in
    place: of a network's classes each copy takes as much memory as all else of a frame."""
    votes *= (_MIN_VOTE + trust**2)[..., None]
    domain_transform_in_place(votes, image, _REACH, _COLOR_SD)
    return LabelEstimate(*_settle(votes))


@kernel
def _settle(total: NDArray[np.float32]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """(h, w) the label with the most of the votes (h, w, C) and its share of them; VOID and 0 where hardly any are."""
    height, width, classes = total.shape
    labels = np.full((height, width), VOID, np.uint8)
    confidence = np.zeros((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            best, heard = 0, total[y, x, 0]
            for c in range(1, classes):
                heard += total[y, x, c]
                if total[y, x, c] > total[y, x, best]:
                    best = c
            if heard >= 1e-4:
                labels[y, x] = best
                confidence[y, x] = total[y, x, best] / heard
    return labels, confidence


def _scene_depth(estimates: list[DepthEstimate]) -> float:
    """Median of the known depths. Raises InputError when there is none."""
    known = [e.depth[(e.depth > 0) & (e.confidence >= _MIN_CONFIDENCE)][::7] for e in estimates]
    if not sum(map(len, known)):
        raise InputError("no reliable depth in any frame, so there are no regions; give another --depth provider")
    return float(np.median(np.concatenate(known)))


def cut_parts(voxels: Voxels, largest: int) -> NDArray[np.int64]:
    """(V,) part of every voxel, 0 the largest by weight; parts beyond the `largest` join a neighbour or are -1.

    The graph joins neighbouring voxels. Where the surface bends towards the viewer (concave) objects touch, so that
    separates more than a convex edge.
    """
    if len(voxels) == 0:
        return np.empty(0, np.int64)
    a, b, cost = _edges(voxels)
    part = cut_graph(a, b, cost, voxels.weight / np.median(voxels.weight), _SCALE).astype(np.int32)
    return _absorb_small(part, a, b, cost, voxels.weight, largest)


def cut_patches(voxels: Voxels) -> NDArray[np.int64]:
    """(V,) small patches of like colour and slope, numbered from 0: an object is made of some tens of them."""
    if len(voxels) == 0:
        return np.empty(0, np.int64)
    return cut_graph(*_edges(voxels), voxels.weight / np.median(voxels.weight), _PATCH_SCALE)


def _edges(voxels: Voxels) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    a, b = touching(voxels.keys)
    cost = np.empty(len(a))
    for start in range(0, len(a), _BLOCK):
        block = slice(start, start + _BLOCK)
        cost[block] = _costs(voxels, a[block], b[block])
    return a, b, cost


def _costs(voxels: Voxels, a: NDArray[np.int32], b: NDArray[np.int32]) -> NDArray[np.float64]:
    between = voxels.position[b] - voxels.position[a]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    bend = 1 - (voxels.normal[a] * voxels.normal[b]).sum(1)
    concave = (between * (voxels.normal[b] - voxels.normal[a])).sum(1) < 0
    color = np.linalg.norm((voxels.color[a] - voxels.color[b]) * [0.5, 1.0, 1.0], axis=1) / _COLOR_UNIT
    return np.asarray(color + np.where(concave, 1.0, 0.3) * bend)


def _absorb_small(
    part: NDArray[np.int32],
    a: NDArray[np.int32],
    b: NDArray[np.int32],
    cost: NDArray[np.float64],
    weight: NDArray[np.float64],
    largest: int,
) -> NDArray[np.int64]:
    """Number the largest parts; the others join the numbered part they are bound to most cheaply, ring by ring."""
    mass = np.bincount(part, weights=weight)
    by_mass = np.lexsort((np.arange(len(mass)), -mass))
    rank = np.full(len(mass), -1, np.int64)
    rank[by_mass[:largest]] = np.arange(min(largest, len(mass)))
    order = np.lexsort((b, a, cost))
    pa, pb = part[a[order]], part[b[order]]
    while True:
        reached = (rank[pa] >= 0) != (rank[pb] >= 0)
        if not reached.any():
            break
        source = np.where(rank[pa] >= 0, pa, pb)[reached]
        target = np.where(rank[pa] >= 0, pb, pa)[reached]
        joined, first = np.unique(target, return_index=True)
        rank[joined] = rank[source[first]]
    return rank[part]


def cut_graph(
    a: NDArray[np.integer], b: NDArray[np.integer], cost: NDArray[np.float64], mass: NDArray[np.float64], scale: float
) -> NDArray[np.int64]:
    """(V,) component of every node, numbered from 0, for edges a-b (E,) with a cost each.

    Two components join when the edge costs no more than the dearest edge inside either plus `scale` over its mass.
    """
    root = _join(np.lexsort((b, a, cost)), a, b, cost, mass, scale)
    return np.unique(root, return_inverse=True)[1]


@kernel
def _root(parent: NDArray[np.int64], i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def _join(
    order: NDArray[np.int64],
    a: NDArray[np.integer],
    b: NDArray[np.integer],
    cost: NDArray[np.float64],
    mass: NDArray[np.float64],
    scale: float,
) -> NDArray[np.int64]:
    parent = np.arange(len(mass))
    total = mass.copy()
    inner = np.zeros(len(mass))
    for e in order:
        i, j = _root(parent, a[e]), _root(parent, b[e])
        if i != j and cost[e] <= min(inner[i] + scale / total[i], inner[j] + scale / total[j]):
            parent[j] = i
            total[i] += total[j]
            inner[i] = cost[e]
    for i in range(len(parent)):
        parent[i] = _root(parent, i)
    return parent
