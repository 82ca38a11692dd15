"""One graph over similarities: the keyframes of a world, what holds each to the next, and the links between them. It
spreads what the links are off; the adjustment of everything follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ..geometry import se3
from ..mapping.move_map import follow_keyframes
from ..sfm.bundle import reprojection_errors
from ..types import Array, Intrinsics
from .links import Link
from .state import Sightings, TrackState

DRIFT_PX = 6.0
"""What the links are off at most, in pixels, without a graph."""


def reprojection_error(
    state: TrackState, intrinsics: Intrinsics, sightings: Mapping[int, Sightings] | None = None
) -> float:
    """Median over the sightings (the state's, or those given), in pixels."""
    errors = []
    for frame_id, seen in sorted((sightings or state.sightings).items()):
        in_cam = se3.transform(state.poses[frame_id], state.points[seen.point])
        errors.append(reprojection_errors(in_cam, seen.xy, intrinsics))
    return float(np.median(np.concatenate(errors)))


def spread_drift(state: TrackState, links: Sequence[Link], intrinsics: Intrinsics, segment: Mapping[int, int]) -> None:
    """Move keyframes, in place, to where the links and the ways between them agree best, and what they see along with
    them, in the worlds whose links are off by more than `DRIFT_PX`; `segment` says of each keyframe which it was in
    before any was joined."""
    for world in sorted({state.segment[link.frame_id] for link in links}):
        inside = [link for link in links if state.segment[link.frame_id] == world]
        if max(link_px(link, state, intrinsics) for link in inside) > DRIFT_PX:
            _spread(state, [k for k in state.keyframes if state.segment[k] == world], inside, segment)


def link_px(link: Link, state: TrackState, intrinsics: Intrinsics) -> float:
    """Median distance in pixels between where the poses put a link's points in its keyframe and where it sees them."""
    in_cam = se3.transform(state.poses[link.frame_id], state.points[link.seen.point])
    longer = max(intrinsics.width, intrinsics.height)
    return float(min(np.median(reprojection_errors(in_cam, link.seen.xy, intrinsics)), longer))


def _spread(state: TrackState, ids: list[int], links: Sequence[Link], segment: Mapping[int, int]) -> None:
    old = np.array([state.poses[i] for i in ids])
    new, scales = optimise_pose_graph(old, np.ones(len(ids)), _edges(state, ids, links, segment))
    others = np.array([i for i in sorted(state.poses) if state.segment[i] == state.segment[ids[0]]])
    _move_points(state, ids, old, new, scales)
    new = new.copy()
    new[:, :3, 3] /= scales[:, None]
    poses = np.array([state.poses[i] for i in others.tolist()])
    followed = follow_keyframes(others, poses, np.array(ids), old, new, 1 / scales)
    state.poses |= dict(zip(others.tolist(), followed, strict=True))
    state.poses |= dict(zip(ids, new, strict=True))


def _edges(state: TrackState, ids: list[int], links: Sequence[Link], segment: Mapping[int, int]) -> Edges:
    """Each keyframe to the next two of its segment, and the links."""
    place, poses = {k: n for n, k in enumerate(ids)}, np.array([state.poses[i] for i in ids])
    depth, loops = np.array([state.median_depth(i) for i in ids]), [link.edge for link in links]
    own = [[n for n, k in enumerate(ids) if segment[k] == s] for s in sorted({segment[k] for k in ids})]
    chain = [(a, b) for row in own for step in (1, 2) for a, b in zip(row, row[step:], strict=False)]
    first = np.array([a for a, _ in chain] + [place[loop.frame1_id] for loop in loops])
    second = np.array([b for _, b in chain] + [place[loop.frame2_id] for loop in loops])
    motions = [poses[b] @ se3.inverse(poses[a]) for a, b in chain]
    # An edge's translation comes in the first keyframe's scale.
    motions += [se3.scaled(loop.frame2_from_frame1, loop.scale) for loop in loops]
    scale = np.concatenate([np.ones(len(chain)), [loop.scale for loop in loops]])
    length = np.array([np.linalg.norm(m[:3, 3]) for m in motions[: len(chain)]])
    sd = np.empty((len(first), 7))
    sd[: len(chain), :3] = (0.02 * length + 0.002 * depth[first[: len(chain)]])[:, None]
    sd[: len(chain), 3:6] = np.radians(0.2)
    sd[: len(chain), 6] = 0.02
    sd[len(chain) :, :3] = 0.01 * depth[second[len(chain) :]][:, None]
    sd[len(chain) :, 3:6] = np.radians(0.5)
    sd[len(chain) :, 6] = [link.scale_sd for link in links]
    robust = np.arange(len(first)) >= len(chain)
    return Edges(first, second, np.array(motions), scale, sd, robust)


def _move_points(state: TrackState, ids: list[int], old: Array, new: Array, scales: Array) -> None:
    """Move points with the first keyframe that sees them."""
    owner = np.full(len(state.points), -1)
    for n in reversed(range(len(ids))):
        owner[state.sightings[ids[n]].point] = n
    for n in range(len(ids)):
        mine = owner == n
        in_cam = state.points[mine] @ old[n, :3, :3].T + old[n, :3, 3]
        state.points[mine] = (in_cam - new[n, :3, 3]) @ new[n, :3, :3] / scales[n]


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
