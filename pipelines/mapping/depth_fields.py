"""A smooth scale field for every proxy depth, chosen so that the views and the triangulated points agree.

The error of a depth network is smooth over a picture and changes from picture to picture; where many pictures see the
same surface its true place is near the middle of what they say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import cg

from pipelines.geometry.camera import project, unproject
from pipelines.mapping.covisibility import overlaps
from pipelines.mapping.views import View

Array = NDArray[np.float64]

ROWS, COLUMNS = 9, 12
"""Nodes of a field; between them the log scale is bilinear."""
SAMPLES_ACROSS = 40
NEIGHBOURS = 16
NODE_SD, STEP_SD = 0.05, 0.08
"""How far a node strays from the proxy as it came, and from its neighbours, relatively."""
PAIR_SD, POINT_SD = 0.03, 0.01
"""Expected disagreement of two views about a surface, and of a view with a triangulated point."""
GROSS = 0.15
"""A larger disagreement is another surface."""
ROUNDS = 4


@dataclass(frozen=True)
class Anchors:
    """Triangulated points of one view: xy (P, 2) in its pixels, depth (P,)."""

    xy: Array
    depth: Array


@dataclass(frozen=True)
class Equations:
    """Q linear equations residual + Σ weight * node = 0; columns and weights (Q, E), residual and sd (Q,)."""

    columns: NDArray[np.int64]
    weights: Array
    residual: Array
    sd: Array


def agree_on_depth(views: Sequence[View], anchors: Mapping[int, Anchors] | None = None) -> list[View]:
    """The views with their depths multiplied by fitted scale fields; `anchors` by frame id."""
    if len(views) < 2:
        return list(views)
    fields = fit_fields(views, anchors or {})
    return [_scaled(v, f) for v, f in zip(views, fields, strict=True)]


def fit_fields(views: Sequence[View], anchors: Mapping[int, Anchors]) -> Array:
    """(N, ROWS, COLUMNS) log scales by robust least squares, re-linearised at every round."""
    fields = np.zeros((len(views), ROWS * COLUMNS))
    samples = [_Samples.of(v) for v in views]
    near = neighbours(views)
    for _ in range(ROUNDS):
        parts = [
            _point_equations(n, v, anchors[v.frame_id], fields) for n, v in enumerate(views) if v.frame_id in anchors
        ]
        parts += [_pair_equations(i, j, samples, views[j], fields) for i, j in near]
        fields = fields + _solve(parts, fields)
    return fields.reshape(-1, ROWS, COLUMNS)


def neighbours(views: Sequence[View]) -> list[tuple[int, int]]:
    """Ordered pairs of views that see the same; of many, a spread over near and far ones."""
    overlap = overlaps(views)
    pairs = []
    for i, row in enumerate(overlap):
        seeing = [int(j) for j in np.argsort(-row, kind="stable") if j != i and row[j] > 0.2]
        pairs += [(i, j) for j in seeing[:: max(len(seeing) // NEIGHBOURS, 1)][:NEIGHBOURS]]
    return pairs


@dataclass(frozen=True)
class _Samples:
    """A grid of pixels with depth: xy (S, 2), depth, trust (S,), rays (S, 3) in the world, center (3,); the maps."""

    xy: Array
    depth: Array
    trust: Array
    rays: Array
    center: Array
    basis: Basis
    depth_map: NDArray[np.float32]
    trust_map: NDArray[np.float32]

    @staticmethod
    def of(view: View) -> _Samples:
        stride = max(view.intrinsics.width // SAMPLES_ACROSS, 1)
        depth_map, trust_map = view.depth.cpu().numpy(), view.trust.cpu().numpy()
        depth = depth_map[stride // 2 :: stride, stride // 2 :: stride].astype(np.float64)
        trust = trust_map[stride // 2 :: stride, stride // 2 :: stride].astype(np.float64)
        rows, columns = np.nonzero((depth > 0) & (trust > 0.1))
        xy = np.stack([columns, rows], 1).astype(np.float64) * stride + (stride // 2 + 0.5)
        world_from_cam = np.linalg.inv(view.cam_from_world.cpu().numpy())
        rays = unproject(xy, np.ones(len(xy)), view.intrinsics) @ world_from_cam[:3, :3].T
        basis = Basis.at(xy, view.intrinsics.width, view.intrinsics.height)
        picked = (depth[rows, columns], trust[rows, columns])
        return _Samples(xy, *picked, rays, world_from_cam[:3, 3], basis, depth_map, trust_map)


@dataclass(frozen=True)
class Basis:
    """The four nodes around each of Q places and their bilinear weights, (Q, 4) both."""

    nodes: NDArray[np.int64]
    weights: Array

    @staticmethod
    def at(xy: Array, width: int, height: int) -> Basis:
        """Nodes span the picture from corner to corner; xy (Q, 2) pixels."""
        gx = np.clip(xy[:, 0] / width, 0, 1) * (COLUMNS - 1)
        gy = np.clip(xy[:, 1] / height, 0, 1) * (ROWS - 1)
        left, top = np.minimum(gx.astype(int), COLUMNS - 2), np.minimum(gy.astype(int), ROWS - 2)
        wx, wy = gx - left, gy - top
        corner = top * COLUMNS + left
        nodes = np.stack([corner, corner + 1, corner + COLUMNS, corner + COLUMNS + 1], 1)
        weights = np.stack([(1 - wx) * (1 - wy), wx * (1 - wy), (1 - wx) * wy, wx * wy], 1)
        return Basis(nodes, weights)

    def __getitem__(self, rows: NDArray) -> Basis:
        return Basis(self.nodes[rows], self.weights[rows])

    def of(self, field: Array) -> Array:
        """(Q,) the field of (ROWS * COLUMNS,) nodes at the places."""
        return (field[self.nodes] * self.weights).sum(1)


def _pair_equations(i: int, j: int, all_samples: list[_Samples], other: View, fields: Array) -> Equations:
    """Samples of view i carried into view j: their depth there against what view j says."""
    samples, there_too = all_samples[i], all_samples[j]
    depth = samples.depth * np.exp(samples.basis.of(fields[i]))
    pose = other.cam_from_world.cpu().numpy()
    along = samples.rays @ pose[2, :3] * depth
    in_other = (samples.center + samples.rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    xy, z = project(in_other, other.intrinsics)
    size = (other.intrinsics.width, other.intrinsics.height)
    inside = np.asarray(((xy >= 0) & (xy < np.array(size))).all(axis=1), dtype=bool)
    place = np.where(inside[:, None], xy, 0).astype(int)
    seen = there_too.depth_map[place[:, 1], place[:, 0]].astype(np.float64)
    trust = there_too.trust_map[place[:, 1], place[:, 0]].astype(np.float64) * samples.trust
    use = inside & (seen > 0) & (z > 0) & (trust > 0.05)
    there = Basis.at(place[use] + 0.5, *size)
    residual = np.log(z[use]) - np.log(seen[use]) - there.of(fields[j])
    near = np.abs(residual) < GROSS
    # A point moves along its ray: how much of that is depth in the other view.
    slope = (along[use] / z[use])[near]
    here, there, nodes = samples.basis[use][near], there[near], fields.shape[1]
    weights = np.concatenate([here.weights * slope[:, None], -there.weights], axis=1)
    columns = np.concatenate([here.nodes + i * nodes, there.nodes + j * nodes], axis=1)
    sd = PAIR_SD / np.sqrt(trust[use][near])
    return Equations(columns, weights, residual[near], sd)


def _point_equations(n: int, view: View, anchors: Anchors, fields: Array) -> Equations:
    """The view's depth at triangulated points."""
    inside = ((anchors.xy >= 0) & (anchors.xy < (view.intrinsics.width, view.intrinsics.height))).all(1)
    xy, truth = anchors.xy[inside], anchors.depth[inside]
    place = xy.astype(int)
    seen = view.depth.cpu().numpy()[place[:, 1], place[:, 0]].astype(np.float64)
    trust = view.trust.cpu().numpy()[place[:, 1], place[:, 0]].astype(np.float64)
    use = (seen > 0) & (truth > 0) & (trust > 0.05)
    basis = Basis.at(xy[use], view.intrinsics.width, view.intrinsics.height)
    residual = np.log(seen[use]) + basis.of(fields[n]) - np.log(truth[use])
    near = np.abs(residual) < 2 * GROSS
    basis, sd = basis[near], POINT_SD / np.sqrt(trust[use][near])
    return Equations(basis.nodes + n * fields.shape[1], basis.weights, residual[near], sd)


def _solve(parts: list[Equations], fields: Array) -> Array:
    """(N, nodes) change of the fields: Cauchy-weighted equations, the prior, and smoothness."""
    count = fields.size
    prior = _prior(len(fields))
    normal = prior.copy()
    right = -(prior @ fields.reshape(-1))
    rows, columns, weights, residuals = [], [], [], []
    offset = 0
    for part in parts:
        # Neighbouring samples err alike: a picture's worth of them counts as a few per node.
        scaled = part.residual / part.sd
        certainty = np.sqrt(0.25 / (1 + scaled**2)) / part.sd
        rows.append(np.repeat(np.arange(offset, offset + len(scaled)), part.columns.shape[1]))
        columns.append(part.columns.ravel())
        weights.append((part.weights * certainty[:, None]).ravel())
        residuals.append(part.residual * certainty)
        offset += len(part.residual)
    if offset:
        design = sparse.csr_matrix(
            (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(offset, count)
        )
        normal = normal + design.T @ design
        right = right - design.T @ np.concatenate(residuals)
    diagonal = sparse.diags(1 / normal.diagonal())
    solution, _ = cg(normal, right, rtol=1e-6, maxiter=500, M=diagonal)
    return solution.reshape(fields.shape)


def _prior(views: int) -> sparse.csr_matrix:
    """Normal matrix of "a node is 0" and "neighbouring nodes are equal" for every view."""
    index = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
        ]
    )
    step = sparse.coo_matrix(
        (np.tile([1.0, -1.0], len(pairs)), (np.repeat(np.arange(len(pairs)), 2), pairs.ravel())),
        shape=(len(pairs), index.size),
    ).tocsr()
    one = sparse.identity(index.size) / NODE_SD**2 + step.T @ step / STEP_SD**2
    return sparse.kron(sparse.identity(views), one, format="csr")


def _scaled(view: View, field: Array) -> View:
    height, width = view.depth.shape
    x = (np.arange(width) + 0.5) / width * (COLUMNS - 1)
    y = (np.arange(height) + 0.5) / height * (ROWS - 1)
    map_x, map_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    log_scale = cv2.remap(field.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    scale = torch.from_numpy(np.exp(log_scale)).to(view.depth.device)
    return view.with_scaled_depth(scale)
