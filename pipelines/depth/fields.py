"""Scale fields: factor from a provider's depth to depth in the world, for each pixel of a keyframe, and their solver.

The solver takes robust linear equations between nodes of many fields, a prior and smoothness.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from ..geometry.posed_depth import PosedDepth, neighbours
from ..system.jit import kernel
from ..types import ProxyMaps

_ROWS_AT_ONCE = 200_000
_MAX_ITERATIONS = 500
"""Of conjugate gradients; 600 keyframes that hang together by pairs alone took 129."""
log = logging.getLogger("msgs_slam")
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
class FieldGrid:
    """rows x columns nodes that span an image from corner to corner; between them the log scale is bilinear.

    The columns lie along the longer side of the image, so that nodes are as far apart in an upright image.
    """

    rows: int
    columns: int

    @property
    def size(self) -> int:
        """Number of grid nodes, rows x columns."""
        return self.rows * self.columns

    def at(self, xy: Array, width: int, height: int) -> Basis:
        """The nodes around pixels xy (Q, 2) of an image of that size."""
        if height > width:
            xy, width, height = xy[:, ::-1], height, width
        gx = np.clip(xy[:, 0] / width, 0, 1) * (self.columns - 1)
        gy = np.clip(xy[:, 1] / height, 0, 1) * (self.rows - 1)
        left, top = np.minimum(gx.astype(int), self.columns - 2), np.minimum(gy.astype(int), self.rows - 2)
        wx, wy = gx - left, gy - top
        corner = top * self.columns + left
        nodes = np.stack([corner, corner + 1, corner + self.columns, corner + self.columns + 1], 1)
        weights = np.stack([(1 - wx) * (1 - wy), wx * (1 - wy), (1 - wx) * wy, wx * wy], 1)
        return Basis(nodes, weights)

    def finer(self, field: Array, grid: FieldGrid) -> Array:
        """(nodes of `grid`,) a field of this grid's (nodes,) at the nodes of another one."""
        x, y = np.meshgrid(np.arange(grid.columns) / (grid.columns - 1), np.arange(grid.rows) / (grid.rows - 1))
        return self.at(np.stack([x.ravel(), y.ravel()], 1), 1, 1).of(field)


FINE = FieldGrid(9, 12)
"""Of the fields that are kept."""


def field_scales(nodes: Array, height: int, width: int) -> NDArray[np.float32]:
    """(H, W) the scale of every pixel by log scales at (rows, columns) nodes of a `FieldGrid`."""
    if height > width:
        return np.ascontiguousarray(field_scales(nodes, width, height).T)
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


@dataclass(frozen=True)
class Prior:
    """Relative standard deviation of a node from its expected value (node_sd) and from its neighbours (step_sd)."""

    grid: FieldGrid
    node_sd: float
    step_sd: float

    def normal(self) -> sparse.csr_matrix:
        """(nodes, nodes) normal matrix of "a node is 0" and "neighbouring nodes are equal"."""
        index = np.arange(self.grid.size).reshape(self.grid.rows, self.grid.columns)
        sides = ((index[:, :-1], index[:, 1:]), (index[:-1], index[1:]))
        pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in sides])
        step = sparse.coo_matrix(
            (np.tile([1.0, -1.0], len(pairs)), (np.repeat(np.arange(len(pairs)), 2), pairs.ravel())),
            shape=(len(pairs), self.grid.size),
        ).tocsr()
        return sparse.identity(self.grid.size) / self.node_sd**2 + step.T @ step / self.step_sd**2


@dataclass(frozen=True)
class Equations:
    """Q linear equations residual + Σ weight * change = 0 between nodes of all fields, numbered through.

    columns and weights (Q, E), residual and sd (Q,). `share`: neighbouring samples may err alike; each then counts as
    so much of an equation.
    """

    columns: NDArray[np.int64]
    weights: Array
    residual: Array
    sd: Array
    share: float = 1.0

    @staticmethod
    def of_places(
        field: NDArray[np.int64] | int, basis: Basis, size: int, residual: Array, sd: Array, share: float
    ) -> Equations:
        """One place of one field each: field (Q,) or a number, `size` nodes a field."""
        columns = basis.nodes + np.reshape(np.asarray(field), (-1, 1)) * size
        return Equations(columns, basis.weights, residual, sd, share)

    def within(self, own: range) -> Equations:
        """With nodes of some fields as the unknowns, counted from the first of them: the others stay as they are."""
        inside = (self.columns >= own.start) & (self.columns < own.stop)
        columns, weights = np.where(inside, self.columns - own.start, 0), np.where(inside, self.weights, 0.0)
        return replace(self, columns=columns, weights=weights)


def solve_fields(parts: Iterable[Equations], fields: Array, expected: Array, prior: Prior) -> Array:
    """(N, nodes) the fields after one step: Cauchy-weighted equations, and `expected` (N, nodes) as far as the prior
    holds them to it. Where the step does not converge, a warning is logged and the fields stay as they were."""
    normals = [sparse.kron(sparse.identity(len(fields)), prior.normal(), format="csr")]
    right = -(normals[0] @ (fields - expected).reshape(-1))
    for design, residual in _designs(parts, fields.size):
        normals.append((design.T @ design).tocsr())
        right = right - design.T @ residual
        # Like sizes are added to each other: the whole is not copied for every part.
        while len(normals) > 1 and normals[-2].nnz <= 2 * normals[-1].nnz:
            normals[-2:] = [normals[-2] + normals[-1]]
    normal = sum(normals[:-1], normals[-1])
    change, unsolved = cg(normal, right, rtol=1e-6, maxiter=_MAX_ITERATIONS, M=sparse.diags(1 / normal.diagonal()))
    if unsolved:
        log.warning(
            "the scales of depth of %d keyframes did not converge in %d iterations and stay as they were: depth may "
            "disagree between these keyframes. Check the depth files or the depth network",
            len(fields),
            _MAX_ITERATIONS,
        )
        return fields
    return fields + change.reshape(fields.shape)


def _designs(parts: Iterable[Equations], size: int) -> Iterator[tuple[sparse.csr_matrix, Array]]:
    """The weighted equations as matrices (Q, size) of some hundred thousand rows, and their residuals (Q,)."""
    waiting: list[Equations] = []
    for part in chain(parts, (None,)):
        if part is not None:
            waiting.append(part)
        if waiting and (part is None or sum(len(p.residual) for p in waiting) >= _ROWS_AT_ONCE):
            certainties = [np.sqrt(p.share / (1 + (p.residual / p.sd) ** 2)) / p.sd for p in waiting]
            certainty = np.concatenate(certainties)
            each = [(c[:, None] * p.weights).ravel() for c, p in zip(certainties, waiting, strict=True)]
            starts = np.cumsum(np.concatenate([[0], *(np.full(len(p.residual), p.columns.shape[1]) for p in waiting)]))
            columns = np.concatenate([p.columns.ravel() for p in waiting])
            design = sparse.csr_matrix((np.concatenate(each), columns, starts), shape=(len(certainty), size))
            yield design, np.concatenate([p.residual for p in waiting]) * certainty
            waiting.clear()


STRIDE = 2
AGREES = 0.03
"""Relative difference up to which another view confirms a depth."""
SEES_THROUGH = 0.08
"""Relative difference from which the other view's surface is plainly behind it."""
_TRUSTED = 0.5


def contradicted(views: Sequence[PosedDepth]) -> Iterator[NDArray[np.bool_]]:
    """(H, W) of each view in turn: pixels whose depth more of the others (two at least) see through than confirm."""
    seeing: dict[int, list[int]] = {}
    for i, j in neighbours(views):
        seeing.setdefault(i, []).append(j)
    for i, view in enumerate(views):
        votes = np.zeros((2, *view.depth[::STRIDE, ::STRIDE].shape), np.int16)
        for j in seeing.get(i, []):
            _vote(view, views[j], votes)
        confirmed, through = votes
        bad = (through >= 2) & (through > confirmed)
        height, width = view.depth.shape
        yield np.repeat(np.repeat(bad, STRIDE, axis=0), STRIDE, axis=1)[:height, :width]


def _vote(view: PosedDepth, other: PosedDepth, votes: NDArray[np.int16]) -> None:
    """Add to votes (2, h, w), of the view's strided pixels: the other view confirms the depth; it sees through it."""
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    cameras = np.stack([view.intrinsics.numbers, other.intrinsics.numbers])
    _count(view.depth, other.depth, other.trust, relative, cameras, votes)


@kernel
def _count(
    depth: NDArray[np.float32],
    seen_depth: NDArray[np.float32],
    trust: NDArray[np.float32],
    relative: NDArray[np.float64],
    cameras: NDArray[np.float64],
    votes: NDArray[np.int16],
) -> None:
    """See `_vote`; relative (4, 4): other camera from this one; cameras (2, 4): fx, fy, cx, cy of both."""
    height, width = seen_depth.shape
    for row in range(votes.shape[1]):
        for column in range(votes.shape[2]):
            d = np.float64(depth[row * STRIDE, column * STRIDE])
            if d <= 0:
                continue
            x = (column * STRIDE + 0.5 - cameras[0, 2]) / cameras[0, 0] * d
            y = (row * STRIDE + 0.5 - cameras[0, 3]) / cameras[0, 1] * d
            z = relative[2, 0] * x + relative[2, 1] * y + relative[2, 2] * d + relative[2, 3]
            if z <= 0:
                continue
            u = relative[0, 0] * x + relative[0, 1] * y + relative[0, 2] * d + relative[0, 3]
            v = relative[1, 0] * x + relative[1, 1] * y + relative[1, 2] * d + relative[1, 3]
            u, v = cameras[1, 0] * u / z + cameras[1, 2], cameras[1, 1] * v / z + cameras[1, 3]
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            there = np.float64(seen_depth[int(v), int(u)])
            if there > 0 and trust[int(v), int(u)] > _TRUSTED:
                if abs(z - there) < AGREES * there:
                    votes[0, row, column] += 1
                elif z < (1 - SEES_THROUGH) * there:
                    votes[1, row, column] += 1
