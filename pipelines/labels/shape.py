"""Names from shape: a network that comes with the program reads height, slope and surroundings of all that a keyframe
shows.

It learned on made rooms, where colour is made up and shape is not: colours only tell it where one thing ends
(`docs/method.md`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.tensors import load_arrays
from ..geometry.camera import resample_nearest, unproject_depth
from ..geometry.sequence import Sequence, resize_area
from ..geometry.voxels import CEILING, FLOOR, Gravity, Voxels, find_near, to_lab, voxel_keys
from ..providers import DepthEstimate
from ..system.unet import UNet
from ..types import Frame

WEIGHTS = Path(__file__).parent / "shape.npz"
NAMES = (
    "wall", "floor", "ceiling", "window", "door", "bed", "seating", "table", "storage", "curtain", "lamp", "picture",
    "screen", "appliance", "plant", "other",
)  # fmt: skip
SIDE = 128
"""Pixels of the longer side that the network sees."""
CHANNELS = 17
_WIDTHS = (16, 32, 48, 64)
_EYE = 1.45
"""Metres of a camera over the floor, which stand for the unit: sizes of furniture go by it."""
_COLUMN = 2
"""Voxels on a side of the columns in which things stand."""
_WAYS = 32
"""Horizontal directions in which is looked for what lies behind a surface."""
_BEHIND = 0.3
"""Metres."""
Array = NDArray[np.float32]


@dataclass(frozen=True)
class RoomShape:
    """The room by the surface of all keyframes: keys (V,) of voxels of `size`, numbers (V, 7): slope,
    normal, top and foot of the column it stands in, root of the share of all surface that lies behind it; `up` (3,),
    heights along it of floor and top, whether floor and ceiling were seen (2,), and the length of a metre."""

    size: float
    keys: NDArray[np.int64]
    numbers: Array
    up: NDArray[np.float64]
    floor: float
    top: float
    seen: tuple[float, float]
    metre: float

    @classmethod
    def of(cls, voxels: Voxels, gravity: Gravity, kind: NDArray[np.int64], centres: NDArray[np.float64]) -> RoomShape:
        """Look at the voxels (V,) with their kinds (V,) of `name_structure`, and the cameras' centres (N, 3)."""
        height = voxels.position @ gravity.up
        low, high = np.quantile(height, [0.005, 0.995]) if len(voxels) else (0.0, 0.0)
        is_floor, is_ceiling = kind == FLOOR, kind == CEILING
        floor = float(np.median(height[is_floor]) if is_floor.any() else low)
        top = float(np.median(height[is_ceiling]) if is_ceiling.any() else high)
        eye = float(np.median(centres @ gravity.up))
        metre = max(eye - floor, 4 * voxels.size) / _EYE
        low, high = _columns(voxels, gravity.up, height)
        behind = np.sqrt(_behind(voxels, gravity.up, _BEHIND * metre))
        numbers = np.column_stack([voxels.normal @ gravity.up, voxels.normal, high, low, behind]).astype(np.float32)
        numbers[:, 4:6] = np.clip((numbers[:, 4:6] - [top, floor]) / metre, -3, 3)
        seen = float(is_floor.any()), float(is_ceiling.any())
        return cls(voxels.size, voxels.keys, numbers, gravity.up, floor, top, seen, metre)

    def channels(self, sequence: Sequence, frame: Frame, estimate: DepthEstimate) -> Array:
        """(CHANNELS, h, w) of one keyframe with a pose."""
        camera = sequence.intrinsics.at_most(SIDE)
        height, width = camera.height, camera.width
        depth, sure = (resample_nearest(a, height, width) for a in (estimate.depth, estimate.confidence))
        world_from_cam = np.linalg.inv(sequence.cam_from_world[frame.id])
        points = unproject_depth(depth, camera) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        known = depth > 0
        at = find_near(self.keys, np.where(known, voxel_keys(points, self.size), -1))
        numbers = np.vstack([self.numbers, np.zeros((1, 7), np.float32)])[at]  # -1 is the last
        ways = points - world_from_cam[:3, 3]
        ways /= np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-12)
        facing = -(numbers[..., 1:4] * ways).sum(-1)
        tall = points @ self.up
        log_depth = np.log(np.maximum(depth / self.metre, 1e-2))
        edges = np.abs(cv2.Laplacian(np.where(known, log_depth, 0).astype(np.float32), cv2.CV_32F)).clip(max=1)
        lab = to_lab(resize_area(sequence.image(frame), width, height)) / np.array([50, 30, 30]) - [1, 0, 0]
        planes = [
            known, at >= 0, np.where(known, log_depth - 1, 0), sure,
            np.where(known, np.clip((tall - self.floor) / self.metre, -1, 4) - 1, 0),
            np.where(known, np.clip((tall - self.top) / self.metre, -4, 1) + 1, 0),
            numbers[..., 0], facing, numbers[..., 4], numbers[..., 5], numbers[..., 6], edges,
            np.full(depth.shape, self.seen[0]), np.full(depth.shape, self.seen[1]), *np.moveaxis(lab, -1, 0),
        ]  # fmt: skip
        return np.stack(planes).astype(np.float32)

    def probabilities(self, sequence: Sequence, frame: Frame, estimate: DepthEstimate) -> Array:
        """(h, w, NAMES) over the whole image; 0 where the room has no surface."""
        planes = torch.from_numpy(self.channels(sequence, frame, estimate))
        with _ONE_AT_A_TIME, torch.no_grad():
            found = load_shape_network()(planes[None]).softmax(1)[0]
        return np.ascontiguousarray(found.permute(1, 2, 0).numpy()) * np.float32(len(self.keys) > 0)


def _flat_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, 3) two horizontal unit vectors."""
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def _columns(
    voxels: Voxels, up: NDArray[np.float64], height: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(V,) least and greatest height of the surface in the upright column around each voxel, and in those beside it."""
    cell = np.floor(voxels.position @ _flat_axes(up).T / (_COLUMN * voxels.size)).astype(np.int64)
    cell -= cell.min(0, initial=0) - 1
    width = int(cell[:, 1].max(initial=0)) + 2
    # Only what is filled is held: one far place would make a grid of everything between.
    filled, at = np.unique(cell[:, 0] * width + cell[:, 1], return_inverse=True)
    best = np.full((2, len(filled)), -np.inf)
    for row, sign in zip(best, (-1.0, 1.0), strict=True):
        np.maximum.at(row, at, sign * height)
    around = best.copy()
    for step in (a * width + b for a in (-1, 0, 1) for b in (-1, 0, 1)):
        place = np.searchsorted(filled, filled + step).clip(max=max(len(filled) - 1, 0))
        there = filled[place] == filled + step
        around[:, there] = np.maximum(around[:, there], best[:, place[there]])
    return -around[0][at], around[1][at]


def _behind(voxels: Voxels, up: NDArray[np.float64], away: float) -> NDArray[np.float64]:
    """(V,) share of all surface that lies at least so far behind each voxel, as its normal has it in the plan; 0 for
    level ones."""
    plan, flat = voxels.position @ _flat_axes(up).T, voxels.normal @ _flat_axes(up).T
    steep = np.linalg.norm(flat, axis=1) > np.sqrt(0.5)
    way = np.round(np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi) * _WAYS).astype(np.int64) % _WAYS
    out = np.zeros(len(voxels))
    for k in range(_WAYS):
        mine = steep & (way == k)
        if mine.any():
            angle = 2 * np.pi * k / _WAYS
            along = plan @ [np.cos(angle), np.sin(angle)]
            order = np.argsort(along)
            summed = np.concatenate([[0.0], np.cumsum(voxels.weight[order])])
            out[mine] = summed[np.searchsorted(along, along[mine] - away, sorter=order)] / summed[-1]
    return out


class ShapeNetwork(UNet):
    """Logits (B, NAMES, h, w) of the channels (B, CHANNELS, h, w) of keyframes."""

    def __init__(self) -> None:
        super().__init__(CHANNELS, _WIDTHS, len(NAMES))


_ONE_AT_A_TIME = Lock()


@cache
def load_shape_network() -> ShapeNetwork:
    """Load the network that comes with the program."""
    network = ShapeNetwork()
    weights = {k: torch.from_numpy(v.astype(np.float32)) for k, v in load_arrays(WEIGHTS).items()}
    network.load_state_dict(weights, strict=False)  # how many batches were seen is not kept
    network.eval()
    network.fuse()
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
