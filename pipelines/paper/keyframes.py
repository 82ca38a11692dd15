"""Which keyframes a frame is mapped with (section 3.3)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..proxy.maps import mean_iou
from ..types import Intrinsics
from .constants import PAPER, Constants

Array = NDArray[np.float64]


def overlap(points_in_world: Array, cam_from_world: Array, intrinsics: Intrinsics) -> float:
    """Eq. (10): η_i, the share of a frame's back-projected points (P, 3) that fall into the image of keyframe i."""
    if len(points_in_world) == 0:
        return 0.0
    xy, z = project(points_in_world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], intrinsics)
    inside = (z > 0) & (xy >= 0).all(-1) & (xy < [intrinsics.width, intrinsics.height]).all(-1)
    return float(inside.mean())


def geometric_keyframes(overlaps: Sequence[float], constants: Constants = PAPER) -> list[int]:
    """Eq. (11): KF_geo = {i : η_i > T_geo}, as places in the list."""
    return [i for i, eta in enumerate(overlaps) if eta > constants.eta]


def semantic_keyframes(
    labels: NDArray[np.uint8], others: NDArray[np.uint8], constants: Constants = PAPER
) -> NDArray[np.bool_]:
    """Eq. (12): (K,) which keyframes' label images (K, h, w) agree with this one's (h, w) by mIoU < T_sem.

    So that a frame is mapped with views that show something else too."""
    return np.asarray(mean_iou(labels, others) < constants.t_sem)


def time_weights(ages: NDArray, reliabilities: NDArray, constants: Constants = PAPER) -> Array:
    """Eq. (13): U(t) = ρ exp(-τ(t_now - t)) ω(t) of keyframes of that age (K,), in keyframes, and mean U (K,)."""
    return constants.rho * np.exp(-constants.tau * ages) * depth_certainty(reliabilities, constants)


def depth_certainty(reliabilities: NDArray, constants: Constants = PAPER) -> Array:
    """Eq. (14): ω(t) = exp(-δ · mean(1 - U(D̂_t))) of mean reliabilities (K,).

    Printed with U itself, which would weigh reliable keyframes less."""
    return np.exp(-constants.delta * (1 - np.asarray(reliabilities, np.float64)))


def select(
    overlaps: Sequence[float],
    differs: NDArray[np.bool_],
    weights: NDArray,
    rng: np.random.Generator,
    constants: Constants = PAPER,
) -> list[int]:
    """At most 20 places of keyframes, drawn by (13) from those of (11) that pass (12), or of (11) where none do."""
    geometric = geometric_keyframes(overlaps, constants)
    pool = [i for i in geometric if differs[i]] or geometric
    if len(pool) <= constants.most_keyframes:
        return pool
    chances = np.asarray(weights, np.float64)[pool]
    return sorted(rng.choice(pool, constants.most_keyframes, replace=False, p=chances / chances.sum()).tolist())
