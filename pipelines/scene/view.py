"""Inputs of the scale estimate: the surface that the keyframes saw, its classes, the gravity direction, the cameras."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import resize_maps, unproject_depth
from ..geometry.room_layout import CEILING, FLOOR, FloorPlane, Gravity, find_gravity, floor_plane, name_structure
from ..geometry.voxels import MIN_WEIGHT, VOXELS_PER_DEPTH, Voxels, find, gather_frame, merge, voxel_keys
from ..providers import resize_area
from ..types import VOID, Array, Intrinsics, ProxyMaps

MIN_CONFIDENCE = 0.3
_SIDE = 200
_MIN_PLANE = 30
"""Voxels without which a floor or a ceiling is none."""


@dataclass(frozen=True)
class SeenFrame:
    """One keyframe: its image (H, W, 3), its maps with depth in the unit of the world, world_from_cam (4, 4)."""

    image: NDArray[np.uint8]
    maps: ProxyMaps
    world_from_cam: Array


@dataclass(frozen=True)
class Scene:
    """kind (V,): floor, ceiling, … of `SegmentLabels.structure`; label (V,) class of each voxel or VOID; names of the
    classes; centres (N, 3) of the cameras; median_depth of what they see. `is_named`: whether
    something that knows things gave the names, and not the geometry."""

    voxels: Voxels
    gravity: Gravity
    kind: NDArray[np.int64]
    label: NDArray[np.uint8]
    names: tuple[str, ...]
    centres: Array
    median_depth: float
    is_named: bool = True

    def named(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """(V,) voxels whose class has one of these names."""
        wanted = [i for i, name in enumerate(self.names) if name.lower() in names]
        return np.isin(self.label, wanted)

    def plane(self, kind: int) -> FloorPlane | None:
        """Fit the plane of the floor or the ceiling; None where too little of it was seen."""
        if (self.kind == kind).sum() < _MIN_PLANE:
            return None
        return floor_plane(self.voxels, self.kind, self.gravity.up, kind)

    @property
    def floor(self) -> FloorPlane | None:
        return self.plane(FLOOR)

    @property
    def ceiling(self) -> FloorPlane | None:
        return self.plane(CEILING)


def build_scene(
    frames: Sequence[SeenFrame], intrinsics: Intrinsics, names: tuple[str, ...], is_named: bool
) -> Scene | None:
    """The scene of some keyframes; None where none of them has reliable depth."""
    known = [f.maps.depth[(f.maps.depth > 0) & (f.maps.confidence >= MIN_CONFIDENCE)][::7] for f in frames]
    if not sum(map(len, known)):
        return None
    median_depth = float(np.median(np.concatenate(known)))
    size = median_depth / VOXELS_PER_DEPTH
    camera = intrinsics.at_most(_SIDE)
    rows = [_gather(f, camera, size) for f in frames]
    # Votes are by the same cubes, however many.
    voxels = merge(size, [(keys, values) for keys, values, _ in rows], sys.maxsize, MIN_WEIGHT)
    cameras = np.array([f.world_from_cam for f in frames])
    gravity = find_gravity(voxels, -cameras[:, :3, 1].mean(0))
    kind = name_structure(voxels, gravity, cameras[:, :3, 3])
    label = _vote(voxels, [votes for _, _, votes in rows])
    return Scene(voxels, gravity, kind, label, names, cameras[:, :3, 3], median_depth, is_named)


def _gather(
    frame: SeenFrame, camera: Intrinsics, size: float
) -> tuple[NDArray[np.int64], Array, tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """The frame's voxels as `gather_frame` gives them, and (Q,) key and label of each of its reliable pixels."""
    rows, columns = camera.height, camera.width
    maps = resize_maps(frame.maps, rows, columns)
    depth, labels, sure = maps.depth, maps.labels, maps.confidence >= MIN_CONFIDENCE
    weight = np.where(sure, maps.confidence, 0).astype(np.float32)
    image = resize_area(frame.image, columns, rows)
    keys, values = gather_frame(depth, weight, image, camera, frame.world_from_cam, size)
    motion = frame.world_from_cam
    points = unproject_depth(depth, camera) @ motion[:3, :3].T + motion[:3, 3]
    use = sure & (depth > 0) & (labels != VOID)
    return keys, values, (voxel_keys(points[use], size), labels[use])


def _vote(voxels: Voxels, votes: Sequence[tuple[NDArray[np.int64], NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """(V,) the label that most pixels of each voxel have; VOID for a voxel without any."""
    label = np.full(len(voxels), VOID, np.uint8)
    if not len(voxels) or not votes:
        return label
    at = find(voxels.keys, np.concatenate([keys for keys, _ in votes]))
    given = np.concatenate([labels for _, labels in votes])
    said, counts = np.unique(at[at >= 0] * 256 + given[at >= 0], return_counts=True)
    # The most last, of as many the first label.
    order = np.lexsort((-said, counts))
    label[said[order] // 256] = said[order] % 256
    return label
