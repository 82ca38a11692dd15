"""The focal length that pairs of views tell, before there is a model.

Two views agree by a fundamental matrix whatever the focal length, but by a relative pose only at the right one. So the
best relative pose of every pair is found at each of a row of focal lengths, and the one at which all pairs together
leave least of their matches unexplained is taken; pairs of a plane or of a turn, which say nothing of it, leave as much
at each. What fundamental matrices alone say (Sweeney et al., Optimizing the Viewing Graph for Structure-from-Motion,
ICCV 2015), from which COLMAP's mappers start otherwise, is up to a third off on recordings from the hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..correspondence.matching import MIN_INLIERS, VerifiedPair
from ..geometry import se3

Array = NDArray[np.float64]

_FOCALS = np.geomspace(0.4, 4.0, 20)
"""In longer sides of the image."""
_PAIRS, _MATCHES = 80, 100
"""Pairs that are looked at, and matches of each."""
_ROUNDS = 10
_MAX_ERROR = 0.6
"""Pixels within which a match obeys a relative pose. With 1 the keyframes of six of seven recordings are farther from
the truth, by up to a quarter, and of one 2 % nearer."""
_UNCALIBRATED = int(pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
_CALIBRATED = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
_IN_PLANE = np.array([1.0, 1.0, 0.0])
"""Singular values of an essential matrix."""


def calibrated(
    camera: pycolmap.Camera, pairs: Sequence[VerifiedPair], xy: Sequence[Array]
) -> tuple[pycolmap.Camera, Sequence[VerifiedPair]]:
    """Return the camera, where its focal length is not known before, with the one that verified pairs of views with
    features xy (F, 2) tell, and the pairs with a relative pose at it and the matches that obey that."""
    if camera.has_prior_focal_length:
        return camera, pairs
    found, size = pycolmap.Camera(camera.todict()), (camera.width, camera.height)
    focal = two_view_focal(pairs, xy, size) or camera.mean_focal_length()
    found.params, found.has_prior_focal_length = [focal, *camera.params[1:]], True
    return found, _with_poses(pairs, xy, size, focal)


def two_view_focal(pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int]) -> float | None:
    """Estimate the focal length, in pixels, of a camera of this size (width, height) from verified pairs of views with
    features xy (F, 2); None where no pair has an epipolar geometry."""
    telling = [p for p in pairs if p.config == _UNCALIBRATED]
    if not telling:
        return None
    chosen = [telling[i] for i in _evenly(len(telling), _PAIRS)]
    count = np.array([min(len(p.matches), _MATCHES) for p in chosen])
    sample, focals = _sampled(chosen, xy, size), _FOCALS * max(size)
    costs = [float(count @ _best_poses(*sample, f)[2]) for f in focals]
    best = int(np.argmin(costs))
    if not 0 < best < len(focals) - 1:
        return float(focals[best])
    before, here, after = costs[best - 1 : best + 2]  # the parabola through them has its vertex at
    shift = (before - after) / max(2 * (before - 2 * here + after), 1e-12)
    return float(focals[best] * (_FOCALS[1] / _FOCALS[0]) ** shift)


def _with_poses(
    pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int], focal: float
) -> list[VerifiedPair]:
    """The pairs, those of a fundamental matrix with the essential one at a focal length."""
    wanted = [p for p in pairs if p.config == _UNCALIBRATED]
    out = [p for p in pairs if p.config != _UNCALIBRATED]
    for start in range(0, len(wanted), _PAIRS):
        block = wanted[start : start + _PAIRS]
        u, v, _ = _best_poses(*_sampled(block, xy, size), focal)
        posed = (_with_pose(*pair, xy, size, focal) for pair in zip(block, u, v, strict=True))
        out += [p for p in posed if p is not None]
    return sorted(out, key=lambda p: (p.first, p.second))


def _with_pose(
    pair: VerifiedPair, u: Array, v: Array, xy: Sequence[Array], size: tuple[int, int], focal: float
) -> VerifiedPair | None:
    """A pair with the essential matrix of U and V, without the matches that contradict it; None if too few are left."""
    middle, numbers = np.array(size) / 2, zip((pair.first, pair.second), pair.matches.T, strict=True)
    x, y = (_rays(xy[k][features] - middle, focal)[None] for k, features in numbers)
    error, _ = _errors(u[None], v[None], x, y)
    matches = pair.matches[np.abs(error[0]) * focal < _MAX_ERROR]
    if len(matches) < MIN_INLIERS:
        return None
    essential = u * _IN_PLANE @ v.T
    to_rays = np.linalg.inv([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    matrices = np.stack([to_rays.T @ essential @ to_rays, essential, pair.matrices[2]])
    return replace(pair, matches=matches, config=_CALIBRATED, matrices=matrices)


def _sampled(pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int]) -> tuple[Array, Array, Array]:
    """(P, 3, 3) fundamental matrices of pixels from the image's centre, and (P, M, 2) such pixels of some matches."""
    middle = np.array(size) / 2
    matches = [p.matches[_evenly(len(p.matches), _MATCHES)] for p in pairs]
    first = np.array([xy[p.first][m[:, 0]] for p, m in zip(pairs, matches, strict=True)]) - middle
    second = np.array([xy[p.second][m[:, 1]] for p, m in zip(pairs, matches, strict=True)]) - middle
    centred = np.array([[1.0, 0.0, middle[0]], [0.0, 1.0, middle[1]], [0.0, 0.0, 1.0]])
    return centred.T @ np.array([p.matrices[0] for p in pairs]) @ centred, first, second


def _evenly(count: int, wanted: int) -> NDArray[np.int64]:
    """`wanted` numbers below `count`, some of them twice where there are fewer."""
    return np.linspace(0, count - 1, wanted).round().astype(np.int64)


def _best_poses(fundamental: Array, first: Array, second: Array, focal: float) -> tuple[Array, Array, Array]:
    """U and V (P, 3, 3) of the essential matrices U diag(1, 1, 0) V^T that explain matches, pixels (P, M, 2) from the
    image's centre, best, and the mean robust epipolar errors (P,) that are left.

    From fundamental matrices (P, 3, 3), by Levenberg-Marquardt: turning U, and V in two directions, gives all others.
    """
    x, y = _rays(first, focal), _rays(second, focal)
    scale = np.diag([focal, focal, 1.0])
    u, _, v = np.linalg.svd(scale @ fundamental @ scale)
    v = v.transpose(0, 2, 1)
    error, jacobian = _errors(u, v, x, y)
    cost, damping = _cost(error * focal), np.full(len(u), 1e-3)
    for _ in range(_ROUNDS):
        weighted = jacobian * (focal**2 / (1 + (error * focal) ** 2))[..., None]
        normal = weighted.transpose(0, 2, 1) @ jacobian
        normal += damping[:, None, None] * normal * np.eye(5) + 1e-9 * np.eye(5)
        step = np.linalg.solve(normal, -(weighted * error[..., None]).sum(1)[..., None])[..., 0]
        turned = u @ _rotation(step[:, :3]), v @ _rotation(np.pad(step[:, 3:], ((0, 0), (0, 1))))
        tried = _errors(*turned, x, y)
        after = _cost(tried[0] * focal)
        better = after < cost
        u, v, error, jacobian = (
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
            for new, old in zip((*turned, *tried), (u, v, error, jacobian), strict=True)
        )
        cost, damping = np.where(better, after, cost), np.where(better, damping / 5, damping * 8)
    return u, v, cost


def _rays(pixels: Array, focal: float) -> Array:
    """(..., 3) from pixels (..., 2) counted from the image's centre."""
    return np.concatenate([pixels / focal, np.ones((*pixels.shape[:-1], 1))], axis=-1)


def _errors(u: Array, v: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """(P, M) roots of Sampson's error of rays (P, M, 3), and their derivatives (P, M, 5) by turns of U and of V."""
    p, q = y @ u, x @ v
    left, right = p * _IN_PLANE, q * _IN_PLANE
    lines = (left @ v.transpose(0, 2, 1))[..., :2], (right @ u.transpose(0, 2, 1))[..., :2]
    size = np.sqrt(np.maximum(sum((line**2).sum(-1) for line in lines), 1e-20))
    moved = np.concatenate([np.cross(right, p), np.cross(left, q)[..., :2]], axis=-1)
    return (p * right).sum(-1) / size, moved / size[..., None]


def _rotation(turn: Array) -> Array:
    """(P, 3, 3) rotations by (P, 3) radians."""
    return se3.exp(np.concatenate([np.zeros_like(turn), turn], axis=1))[:, :3, :3]


def _cost(pixels: Array) -> Array:
    """(P,) means of Cauchy's loss at a pixel's width."""
    return np.log1p(pixels**2).mean(1)
