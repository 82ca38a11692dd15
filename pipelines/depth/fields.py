"""Scale fields: factor from a provider's depth to depth in the world, for each pixel of a keyframe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import ProxyMaps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Basis:
    """The four nodes around each of Q places and their bilinear weights, (Q, 4) both."""

    nodes: NDArray[np.int64]
    weights: Array

    def __getitem__(self, rows: NDArray) -> Basis:
        return Basis(self.nodes[rows], self.weights[rows])

    def of(self, field: Array) -> Array:
        """(Q,) a field of (nodes,) at the places; of one (Q, nodes) row a place likewise."""
        values = field[self.nodes] if field.ndim == 1 else np.take_along_axis(field, self.nodes, 1)
        return np.asarray((values * self.weights).sum(1))


@dataclass(frozen=True)
class Grid:
    """rows x columns nodes that span an image from corner to corner; between them the log scale is bilinear."""

    rows: int
    columns: int

    @property
    def size(self) -> int:
        """Number of grid nodes, rows x columns."""
        return self.rows * self.columns

    def at(self, xy: Array, width: int, height: int) -> Basis:
        """The nodes around pixels xy (Q, 2) of an image of that size."""
        gx = np.clip(xy[:, 0] / width, 0, 1) * (self.columns - 1)
        gy = np.clip(xy[:, 1] / height, 0, 1) * (self.rows - 1)
        left, top = np.minimum(gx.astype(int), self.columns - 2), np.minimum(gy.astype(int), self.rows - 2)
        wx, wy = gx - left, gy - top
        corner = top * self.columns + left
        nodes = np.stack([corner, corner + 1, corner + self.columns, corner + self.columns + 1], 1)
        weights = np.stack([(1 - wx) * (1 - wy), wx * (1 - wy), (1 - wx) * wy, wx * wy], 1)
        return Basis(nodes, weights)

    def finer(self, field: Array, grid: Grid) -> Array:
        """(nodes of `grid`,) a field of this grid's (nodes,) at the nodes of another one."""
        x, y = np.meshgrid(np.arange(grid.columns) / (grid.columns - 1), np.arange(grid.rows) / (grid.rows - 1))
        return self.at(np.stack([x.ravel(), y.ravel()], 1), 1, 1).of(field)


FINE = Grid(9, 12)
"""Of the fields that are kept."""


def field_scales(nodes: Array, height: int, width: int) -> NDArray[np.float32]:
    """(H, W) the scale of every pixel by log scales at (rows, columns) nodes."""
    rows, columns = nodes.shape
    x = (np.arange(width) + 0.5) / width * (columns - 1)
    y = (np.arange(height) + 0.5) / height * (rows - 1)
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    # remap interpolates between the pixels at integer places: the nodes.
    logs = cv2.remap(nodes.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.exp(logs).astype(np.float32)


@dataclass(frozen=True)
class DepthFields:
    """Log scales (rows, columns) at the nodes of each keyframe's field, by frame id: depth in the world = exp(field) x
    the provider's. Without any field the provider's depth is taken to be in the unit of the world."""

    of_frame: Mapping[int, Array]

    def scales(self, frame_id: int, height: int, width: int) -> NDArray[np.float32]:
        """(H, W) the scale of every pixel of a frame."""
        if not self.of_frame:
            return np.ones((height, width), np.float32)
        return field_scales(self.of_frame[frame_id], height, width)

    def in_world(self, frame_id: int, maps: ProxyMaps) -> ProxyMaps:
        """Return the maps with depth in the unit of the world; unknown for a frame without a field."""
        if self.of_frame and frame_id not in self.of_frame:
            return replace(maps, depth=np.zeros_like(maps.depth))
        return replace(maps, depth=maps.depth * self.scales(frame_id, *maps.depth.shape))
