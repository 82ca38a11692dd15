"""A pose graph over similarities: consecutive and loop edges, by Gauss-Newton (first term of MSGS-SLAM eq. 26).

An own solver, because pycolmap's pose graph averages rotations and knows no Sim(3) edges. A node is
cam_from_world with a scale: x_cam = scale * R x_world + t. Loop edges have Cauchy's loss, so that one that
contradicts all others loses its pull.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ..geometry import se3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Edges:
    """first (E,), second (E,) node indices; second_from_first (E, 4, 4) with scale (E,); sd (E, 7): of translation
    (3), rotation (3, radians) and log scale; robust (E,) bool."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    second_from_first: Array
    scale: Array
    sd: Array
    robust: NDArray[np.bool_]


def residuals(poses: Array, scales: Array, edges: Edges) -> Array:
    """(E, 7) normalised: twist and log scale between each measured edge and the nodes (N, 4, 4), (N,)."""
    first, second = poses[edges.first], poses[edges.second]
    relative_scale = scales[edges.second] / scales[edges.first]
    rotation = second[:, :3, :3] @ np.swapaxes(first[:, :3, :3], 1, 2)
    translation = second[:, :3, 3] - relative_scale[:, None] * np.einsum("eij,ej->ei", rotation, first[:, :3, 3])
    measured = edges.second_from_first
    error = np.tile(np.eye(4), (len(rotation), 1, 1))
    error[:, :3, :3] = rotation @ np.swapaxes(measured[:, :3, :3], 1, 2)
    error[:, :3, 3] = translation - np.einsum("eij,ej->ei", error[:, :3, :3], measured[:, :3, 3])
    # The translation's difference itself, not the twist's: it is what the standard deviations are given for.
    twist = se3.log(error)
    twist[:, :3] = error[:, :3, 3]
    return np.concatenate([twist, np.log(relative_scale / edges.scale)[:, None]], 1) / edges.sd


def optimise_pose_graph(
    poses: Array, scales: Array, edges: Edges, iterations: int = 30, width: float = 3.0
) -> tuple[Array, Array]:
    """Nodes (N, 4, 4) with their scales (N,) that agree best with all edges; the first node stays."""
    n = len(poses)
    damping = 1e-6
    values = residuals(poses, scales, edges)
    cost = _cost(values, edges.robust, width)
    for _ in range(iterations):
        normal, right = _normal_equations(poses, scales, edges, values, width)
        improved = False
        while damping < 1e6 and not improved:
            diagonal = csc_matrix((damping * normal.diagonal() + 1e-12, (range(7 * n - 7), range(7 * n - 7))))
            step = np.concatenate([np.zeros(7), splu((normal + diagonal).tocsc()).solve(right)]).reshape(n, 7)
            moved, rescaled = apply_step(poses, scales, step)
            tried = residuals(moved, rescaled, edges)
            tried_cost = _cost(tried, edges.robust, width)
            improved = tried_cost < cost
            damping = damping / 10 if improved else damping * 10
        if not improved:
            break
        converged = cost - tried_cost < 1e-9 * cost
        poses, scales, values, cost = moved, rescaled, tried, tried_cost
        if converged:
            break
    return poses, scales


def apply_step(poses: Array, scales: Array, step: Array) -> tuple[Array, Array]:
    """Left perturbation of every node by (translation, rotation, log scale) (N, 7); the scale acts in the camera."""
    factor = np.exp(step[:, 6])
    return se3.exp(step[:, :6]) @ se3.scaled(poses, factor), scales * factor


def _cost(values: Array, robust: NDArray[np.bool_], width: float) -> float:
    squared = (values**2).sum(1)
    return float(np.where(robust, width**2 * np.log1p(squared / width**2), squared).sum())


def _normal_equations(
    poses: Array, scales: Array, edges: Edges, values: Array, width: float
) -> tuple[csc_matrix, Array]:
    """Of all nodes but the first, by central differences of both nodes of each edge: 14 columns, all edges at once."""
    count = len(edges.first)
    jacobian = np.zeros((count, 7, 14))
    both = Edges(np.arange(count), np.arange(count) + count, *(getattr(edges, n) for n in _MEASURED))
    node_poses = np.concatenate([poses[edges.first], poses[edges.second]])
    node_scales = np.concatenate([scales[edges.first], scales[edges.second]])
    for column in range(14):
        step = np.zeros((2 * count, 7))
        step[(column // 7) * count :, :][:count, column % 7] = 1e-6
        plus = residuals(*apply_step(node_poses, node_scales, step), both)
        minus = residuals(*apply_step(node_poses, node_scales, -step), both)
        jacobian[:, :, column] = (plus - minus) / 2e-6
    weight = np.where(edges.robust, 1 / (1 + (values**2).sum(1) / width**2), 1.0)
    weighted = jacobian * weight[:, None, None]
    blocks = np.einsum("eki,ekj->eij", weighted, jacobian)
    right = -np.einsum("eki,ek->ei", weighted, values)
    index = np.concatenate([7 * edges.first[:, None] + np.arange(7), 7 * edges.second[:, None] + np.arange(7)], axis=1)
    rows, columns = np.broadcast_arrays(index[:, :, None], index[:, None, :])
    size = 7 * len(poses)
    normal = coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), (size, size)).tocsc()
    total = np.zeros(size)
    np.add.at(total, index.ravel(), right.ravel())
    return normal[7:, 7:], total[7:]


_MEASURED = ("second_from_first", "scale", "sd", "robust")
