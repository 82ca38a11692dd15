"""Cameras whose poses the images determine relative to each other, by the covariance of an adjustment.

Reprojection errors do not tell. Where all that is seen is a narrow strip, the floor below a bare wall, cameras can turn
about the strip and their distances can grow, while every point stays within a fraction of a pixel.
"""

from collections.abc import Container, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry import se3
from ..system.memory import windows_of
from ..types import Array, Intrinsics
from .adjust import FEATURE_SD
from .bundle import Bundle, Problem
from .seams import MIN_POINTS

MAX_SD = 0.005
"""Of two cameras that are determined relative to each other: standard deviation of the position in depths of what they
see, and of the direction in radians, for independent errors of `FEATURE_SD` (also of what was followed: those are alike
in neighbouring frames). Of 40 recordings those whose paths are right have at most 0.0042 between neighbours, two that
break before bare walls 0.0057 and 0.0093. True errors are 5 to 15 times as large: features of one strip are off
together."""
_AT_ONCE, _SHARED = 200, 80
"""Cameras of one dense covariance, and those that it has in common with the next."""


def loose_cameras(
    bundle: Bundle, intrinsics: Intrinsics, parts: Iterable[Sequence[int]], least: int, counted: Container[int]
) -> tuple[list[int], list[list[int]]]:
    """Indices of the cameras that the images do not determine against most of their part, in groups of fewer than
    `least` of those `counted`; and the larger groups beside the largest of a part. `parts` are cameras that share no
    point with those of another. Where no group has most of a part, nothing is better known than the rest: what is
    beside its largest group counts as one larger group."""
    loose: list[int] = []
    apart: list[list[int]] = []
    for part in parts:
        members = np.array(sorted(part), np.int64)
        largest, *groups = pose_groups(_part(bundle, members), intrinsics)
        if 2 * len(largest) <= len(members):
            apart.append(members[sorted(k for group in groups for k in group)].tolist())
            continue
        for group in groups:
            inside = members[group].tolist()
            if sum(k in counted for k in inside) < least:
                loose += inside
            else:
                apart.append(inside)
    return sorted(loose), apart


def pose_groups(bundle: Bundle, intrinsics: Intrinsics) -> list[list[int]]:
    """Indices of the cameras of a bundle in groups, the largest first: within one the images determine the poses.

    Of many cameras windows are looked at, whose covariances are larger than those of all. What two cameras that are in
    no window together see is taken to determine them.
    """
    count = len(bundle.cam_from_world)
    windows = windows_of(count, _AT_ONCE, _SHARED)
    ties = [_far_ties(bundle, windows)] if len(windows) > 1 else []
    for window in windows:
        pairs, sd = relative_sds(_part(bundle, np.arange(window.start, window.stop)), intrinsics)
        ties.append(pairs[sd <= MAX_SD] + window.start)
    first, second = np.concatenate(ties).T
    _, label = connected_components(coo_matrix((np.ones(len(first)), (first, second)), (count, count)), directed=False)
    groups = [np.flatnonzero(label == n).tolist() for n in range(int(label.max(initial=-1)) + 1)]
    return sorted(groups, key=lambda g: (-len(g), g))


def relative_sds(bundle: Bundle, intrinsics: Intrinsics) -> tuple[NDArray[np.int64], Array]:
    """Pairs (E, 2) of cameras that share a point, and how exactly one's pose relative to the other's is determined
    (E,), as in `MAX_SD`: the larger of position and direction."""
    depth = _median_depths(bundle)
    unit = float(np.median(depth))
    scaled = replace(
        bundle, cam_from_world=se3.scaled(bundle.cam_from_world, 1 / unit), points=bundle.points / unit,
        obs_depth=bundle.obs_depth / unit, obs_sd=np.full(len(bundle.obs_cam), FEATURE_SD),
    )  # fmt: skip
    problem = Problem(scaled, intrinsics)
    count, at = len(depth), (np.ascontiguousarray(scaled.cam_from_world), scaled.points)
    blocks, _, _ = problem.reduced(at, problem.linearise(*at), 1e-9)
    upper = np.zeros((count, 6, count, 6))
    upper[problem.pairs[:, 0], :, problem.pairs[:, 1], :] = blocks
    dense = np.triu(upper.reshape(6 * count, 6 * count))
    dense += np.triu(dense, 1).T
    # What moves and scales the whole is free: held as firmly as all the rest is, so that there is an inverse.
    free = _free_motions(scaled.cam_from_world)
    firm = np.trace(dense) / len(dense) * free @ free.T
    covariance = np.linalg.inv(dense + firm + 1e-9 * np.eye(6 * count)).reshape(count, 6, count, 6)
    pairs = problem.pairs[problem.pairs[:, 0] != problem.pairs[:, 1]]
    a, b = pairs.T
    carry = _adjoint(scaled.cam_from_world[b] @ se3.inverse(scaled.cam_from_world[a]))
    back = np.swapaxes(carry, 1, 2)
    mixed = carry @ covariance[a, :, b, :]
    relative = covariance[b, :, b, :] + carry @ covariance[a, :, a, :] @ back - mixed - np.swapaxes(mixed, 1, 2)
    variance = np.maximum(np.einsum("eii->ei", relative), 0.0)
    place, turn = variance[:, :3].sum(1), variance[:, 3:].sum(1)
    return pairs, np.sqrt(np.maximum(place / np.minimum(depth[a], depth[b]) ** 2 * unit**2, turn))


def _median_depths(bundle: Bundle) -> Array:
    """(N,) of what each camera sees; the median of all for one that sees nothing."""
    depth, order = bundle.points_in_cam()[:, 2], np.argsort(bundle.obs_cam, kind="stable")
    order = order[depth[order] > 0]
    edges = np.searchsorted(bundle.obs_cam[order], np.arange(len(bundle.cam_from_world) + 1)).tolist()
    own = [depth[order[i:j]] for i, j in pairwise(edges)]
    middle = float(np.median(depth[order])) if len(order) else 1.0
    return np.array([np.median(d) if len(d) else middle for d in own])


def _free_motions(cam_from_world: Array) -> Array:
    """(6 N, 7) orthonormal steps of all cameras that no image tells: those of the whole, and its scale."""
    count = len(cam_from_world)
    steps = np.zeros((count, 6, 7))
    steps[:, :, :6] = _adjoint(cam_from_world)
    centre = se3.inverse(cam_from_world)[:, :3, 3].mean(0)
    steps[:, :3, 6] = cam_from_world[:, :3, :3] @ centre + cam_from_world[:, :3, 3]
    return np.linalg.qr(steps.reshape(6 * count, 7))[0]


def _adjoint(motions: Array) -> Array:
    """(N, 6, 6): what a twist (translation first) is after each of the motions (N, 4, 4)."""
    out, turn, shift = np.zeros((len(motions), 6, 6)), motions[:, :3, :3], motions[:, :3, 3]
    out[:, :3, :3] = out[:, 3:, 3:] = turn
    out[:, :3, 3:] = np.cross(shift[:, :, None], turn, axis=1)
    return out


def _part(bundle: Bundle, cameras: NDArray[np.int64]) -> Bundle:
    """The bundle of these cameras, with the points that they see."""
    number = np.full(len(bundle.cam_from_world) + 1, -1)  # the last one stands for no source
    number[cameras] = np.arange(len(cameras))
    part = bundle.select(number[bundle.obs_cam] >= 0)
    used, point = np.unique(part.obs_point, return_inverse=True)
    return replace(
        part, cam_from_world=bundle.cam_from_world[cameras], points=bundle.points[used],
        obs_cam=number[part.obs_cam], obs_point=point.astype(np.int64), obs_source=number[part.obs_source],
    )  # fmt: skip


def _far_ties(bundle: Bundle, windows: list[range]) -> NDArray[np.int64]:
    """(E, 2) cameras that share enough points for a pose and are in no window together."""
    seen = csr_matrix((np.ones(len(bundle.obs_cam)), (bundle.obs_cam, bundle.obs_point)))
    shared = coo_matrix(seen @ seen.T)
    first, second = shared.row, shared.col
    far = (shared.data >= MIN_POINTS) & (first < second)
    for window in windows:
        far &= (first < window.start) | (second >= window.stop)
    return np.column_stack([first[far], second[far]]).astype(np.int64)
