"""The focal length that pairs of views tell, before there is a model.

Two views agree by a fundamental matrix whatever the focal length, but by a relative pose only at the right one. So the
best relative pose of every pair is found at each of a row of focal lengths, and the one at which all pairs together
leave least of their matches unexplained is taken; pairs of a plane or of a turn, which say nothing of it, leave as much
at each. What fundamental matrices alone say (Sweeney et al., Optimizing the Viewing Graph for Structure-from-Motion,
ICCV 2015), from which COLMAP's mappers start otherwise, is up to a third off on recordings from the hand.

A lens that bends lines is looked for by the way: as a division model (Fitzgibbon, Simultaneous linear estimation of
multiple view geometry and lens distortion, CVPR 2001), without which the focal length is up to 40 % off.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..geometry import se3
from .matching import MIN_INLIERS, VerifiedPair

Array = NDArray[np.float64]

_FOCALS = np.geomspace(0.4, 4.0, 20)
"""In longer sides of the image."""
_PAIRS, _MATCHES = 80, 100
"""Pairs that are looked at, and matches of each."""
_ROUNDS = 10
_MAX_ERROR = 0.6
"""Pixels within which a match obeys a relative pose. With 1 the keyframes of six of seven recordings are farther from
the truth, by up to a quarter, and of one 2 % nearer."""
_BENDS, _BETWEEN = (-0.3, -0.2, -0.1, 0.1), 0.05
"""Of a pixel at a corner of the image, by how much farther in or out it would be without distortion."""
_WIDE = 12
"""So many of the focal lengths are those of lenses that bend: up to 1.5 longer sides."""
_MIN_GAIN = 0.02
"""Share of the cost that a bend must explain to be one."""
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
    focal, bend = two_view_lens(pairs, xy, size) or (camera.mean_focal_length(), 0.0)
    found.params, found.has_prior_focal_length = [focal, *camera.params[1:]], True
    if bend:
        found.params = [*found.params[:3], bend * (2 * focal / np.hypot(*size)) ** 2]
    return found, _with_poses(pairs, xy, size, focal, bend)


def two_view_lens(
    pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int]
) -> tuple[float, float] | None:
    """Estimate the focal length, in pixels, of a camera of this size (width, height) from verified pairs of views with
    features xy (F, 2), and how much it bends, see `_BENDS`; None where no pair has an epipolar geometry."""
    telling = [p for p in pairs if p.config == _UNCALIBRATED]
    if not telling:
        return None
    chosen = [telling[i] for i in _evenly(len(telling), _PAIRS)]
    count = np.array([min(len(p.matches), _MATCHES) for p in chosen])
    fundamental, first, second = _sampled(chosen, xy, size)
    focals = _FOCALS * max(size)

    def costs(bend: float, steps: range) -> Array:
        x, y = _unbent(first, size, bend), _unbent(second, size, bend)
        scale = 1 + bend * _outwards(second, size)[..., 0].mean()  # of pixels there, in pixels here
        out = np.full(len(focals), np.inf)
        out[steps] = [count @ _best_poses(fundamental, x, y, f, scale)[2] for f in focals[steps]]
        return out

    wide = range(_WIDE)
    straight = costs(0.0, range(len(focals)))
    found = {bend: costs(bend, wide) for bend in _BENDS}
    best = min(found, key=lambda bend: found[bend].min())
    if found[best].min() > (1 - _MIN_GAIN) * straight.min():
        return _vertex(straight, focals), 0.0
    found |= {bend: costs(bend, wide) for bend in (best - _BETWEEN, best + _BETWEEN)}
    best = min(found, key=lambda bend: found[bend].min())
    return _vertex(found[best], focals), best


def _vertex(costs: Array, focals: Array) -> float:
    """The focal length of least cost, between steps."""
    best = int(np.argmin(costs))
    if not 0 < best < len(focals) - 1 or not np.isfinite(costs[best - 1 : best + 2]).all():
        return float(focals[best])
    before, here, after = costs[best - 1 : best + 2]  # the parabola through them has its vertex at
    shift = (before - after) / max(2 * (before - 2 * here + after), 1e-12)
    return float(focals[best] * (_FOCALS[1] / _FOCALS[0]) ** shift)


def _outwards(pixels: Array, size: tuple[int, int]) -> Array:
    """(..., 1) squares of the distances of pixels (..., 2) from the image's centre, to a corner 1."""
    return (pixels**2).sum(-1, keepdims=True) / (np.array(size) ** 2).sum() * 4


def _unbent(pixels: Array, size: tuple[int, int], bend: float) -> Array:
    """Pixels (..., 2) from the image's centre where they would be without distortion."""
    return pixels / (1 + bend * _outwards(pixels, size))


def _with_poses(
    pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int], focal: float, bend: float
) -> list[VerifiedPair]:
    """The pairs, those of a fundamental matrix with the essential one at a focal length."""
    wanted = [p for p in pairs if p.config == _UNCALIBRATED]
    out = [p for p in pairs if p.config != _UNCALIBRATED]
    for start in range(0, len(wanted), _PAIRS):
        block = wanted[start : start + _PAIRS]
        fundamental, first, second = _sampled(block, xy, size)
        u, v, _ = _best_poses(fundamental, _unbent(first, size, bend), _unbent(second, size, bend), focal)
        posed = (_with_pose(*pair, xy, size, focal, bend) for pair in zip(block, u, v, strict=True))
        out += [p for p in posed if p is not None]
    return sorted(out, key=lambda p: (p.first, p.second))


def _with_pose(
    pair: VerifiedPair, u: Array, v: Array, xy: Sequence[Array], size: tuple[int, int], focal: float, bend: float
) -> VerifiedPair | None:
    """A pair with the essential matrix of U and V, without the matches that contradict it; None if too few are left. Of
    a lens that bends all stay: it is known too roughly to judge by."""
    middle, numbers = np.array(size) / 2, zip((pair.first, pair.second), pair.matches.T, strict=True)
    x, y = (_rays(xy[k][features] - middle, focal)[None] for k, features in numbers)
    error, _ = _errors(u[None], v[None], x, y)
    matches = pair.matches[(np.abs(error[0]) * focal < _MAX_ERROR) | (bend != 0)]
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


def _best_poses(
    fundamental: Array, first: Array, second: Array, focal: float, pixel: float = 1.0
) -> tuple[Array, Array, Array]:
    """U and V (P, 3, 3) of the essential matrices U diag(1, 1, 0) V^T that explain matches, pixels (P, M, 2) from the
    image's centre, best, and the mean robust epipolar errors (P,) that are left, in units of 1 / `pixel`.

    From fundamental matrices (P, 3, 3), by Levenberg-Marquardt: turning U, and V in two directions, gives all others.
    """
    x, y = _rays(first, focal), _rays(second, focal)
    scale = np.diag([focal, focal, 1.0])
    u, _, v = np.linalg.svd(scale @ fundamental @ scale)
    v = v.transpose(0, 2, 1)
    error, jacobian = _errors(u, v, x, y)
    size = focal * pixel
    cost, damping = _cost(error * size), np.full(len(u), 1e-3)
    for _ in range(_ROUNDS):
        weighted = jacobian * (size**2 / (1 + (error * size) ** 2))[..., None]
        normal = weighted.transpose(0, 2, 1) @ jacobian
        normal += damping[:, None, None] * normal * np.eye(5) + 1e-9 * np.eye(5)
        step = np.linalg.solve(normal, -(weighted * error[..., None]).sum(1)[..., None])[..., 0]
        turned = u @ _rotation(step[:, :3]), v @ _rotation(np.pad(step[:, 3:], ((0, 0), (0, 1))))
        tried = _errors(*turned, x, y)
        after = _cost(tried[0] * size)
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
