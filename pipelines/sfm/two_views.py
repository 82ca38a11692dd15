"""Pairs of views before there is a model: the focal length, and whether the camera moved or only turned.

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

from ...formats.errors import InputError
from ..geometry import se3
from ..geometry.se3 import best_rotation
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
_DISTORTIONS, _BETWEEN = (-0.3, -0.2, -0.1, 0.1), 0.05
"""Relative radial displacement at the image corner (division model)."""
_WIDE = 12
"""So many of the focal lengths are those of lenses that distortion: up to 1.5 longer sides."""
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
    focal, distortion = two_view_lens(pairs, xy, size) or (camera.mean_focal_length(), 0.0)
    found.params, found.has_prior_focal_length = [focal, *camera.params[1:]], True
    if distortion:
        found.params = [*found.params[:3], distortion * (2 * focal / np.hypot(*size)) ** 2]
    return found, _with_poses(pairs, xy, size, focal, distortion)


def two_view_lens(
    pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int]
) -> tuple[float, float] | None:
    """Estimate the focal length, in pixels, of a camera of this size (width, height) from verified pairs of views with
    features xy (F, 2), and its distortion, see `_DISTORTIONS`; None where no pair has an epipolar geometry."""
    telling = [p for p in pairs if p.config == _UNCALIBRATED]
    if not telling:
        return None
    chosen = [telling[i] for i in _evenly(len(telling), _PAIRS)]
    count = np.array([min(len(p.matches), _MATCHES) for p in chosen])
    fundamental, first, second = _sampled(chosen, xy, size)
    focals = _FOCALS * max(size)

    def costs(distortion: float, steps: range) -> Array:
        x, y = _undistort(first, size, distortion), _undistort(second, size, distortion)
        scale = 1 + distortion * _outwards(second, size)[..., 0].mean()  # of pixels there, in pixels here
        out = np.full(len(focals), np.inf)
        out[steps] = [count @ _best_poses(fundamental, x, y, f, scale)[2] for f in focals[steps]]
        return out

    wide = range(_WIDE)
    straight = costs(0.0, range(len(focals)))
    found = {distortion: costs(distortion, wide) for distortion in _DISTORTIONS}
    best = min(found, key=lambda distortion: found[distortion].min())
    if found[best].min() > (1 - _MIN_GAIN) * straight.min():
        return _vertex(straight, focals), 0.0
    found |= {distortion: costs(distortion, wide) for distortion in (best - _BETWEEN, best + _BETWEEN)}
    best = min(found, key=lambda distortion: found[distortion].min())
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


def _undistort(pixels: Array, size: tuple[int, int], distortion: float) -> Array:
    """Pixels (..., 2) from the image's centre where they would be without distortion."""
    return pixels / (1 + distortion * _outwards(pixels, size))


def _with_poses(
    pairs: Sequence[VerifiedPair], xy: Sequence[Array], size: tuple[int, int], focal: float, distortion: float
) -> list[VerifiedPair]:
    """The pairs, those of a fundamental matrix with the essential one at a focal length."""
    wanted = [p for p in pairs if p.config == _UNCALIBRATED]
    out = [p for p in pairs if p.config != _UNCALIBRATED]
    for start in range(0, len(wanted), _PAIRS):
        block = wanted[start : start + _PAIRS]
        fundamental, first, second = _sampled(block, xy, size)
        u, v, _ = _best_poses(
            fundamental, _undistort(first, size, distortion), _undistort(second, size, distortion), focal
        )
        posed = (_with_pose(*pair, xy, size, focal, distortion) for pair in zip(block, u, v, strict=True))
        out += [p for p in posed if p is not None]
    return sorted(out, key=lambda p: (p.first, p.second))


def _with_pose(
    pair: VerifiedPair, u: Array, v: Array, xy: Sequence[Array], size: tuple[int, int], focal: float, distortion: float
) -> VerifiedPair | None:
    """A pair with the essential matrix of U and V and the matches that obey it (all, with distortion), if enough."""
    middle, numbers = np.array(size) / 2, zip((pair.first, pair.second), pair.matches.T, strict=True)
    x, y = (_rays(xy[k][features] - middle, focal)[None] for k, features in numbers)
    error, _ = _errors(u[None], v[None], x, y)
    matches = pair.matches[(np.abs(error[0]) * focal < _MAX_ERROR) | (distortion != 0)]
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
    """U and V (P, 3, 3) of the essential matrices U diag(1, 1, 0) V^T best for pixels (P, M, 2); their costs."""
    # Levenberg-Marquardt from the fundamental matrices: turning U, and V in two directions, gives all others.
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


# parallax --------------------------------------------------------------------------------------------------------

HOW_TO_FILM = (
    "Film again while walking: move the camera sideways by a tenth of the distance to what it shows, rather than "
    "turning on the spot"
)
_MOVING_FRACTION = 0.01
_TURN_ONLY_PX = 1.5
_MIN_DISPLACEMENT_PX = 10.0
_SAMPLED_PAIRS = 40
_MAX_MATCH = 0.9
_FEWEST_VIEWS = 3
_COARSE_FOCALS = np.geomspace(0.4, 4.0, 13)
_FINE_FACTORS = np.geomspace(0.85, 1.18, 9)


def require_motion(largest_displacement: float, has_detail: bool) -> None:
    """Raise InputError for a camera that does not move, displacement as a fraction of the image's longer
    side, and for images without detail."""
    if not has_detail:
        raise InputError(
            "no image shows detail that could be followed into another one: they are dark, of plain surfaces, or out "
            "of focus. Look at them; more light, or a view with furniture in it, gives detail"
        )
    if largest_displacement < _MOVING_FRACTION:
        raise InputError(
            f"there is no parallax: over the whole source the image moves by at most {largest_displacement:.2%} of "
            f"its longer side, so no depth can be found. Either the camera stands still, or the images are all the "
            f"same: look at them. {HOW_TO_FILM}"
        )


def require_parallax(
    pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float | None
) -> None:
    """Raise InputError when turning on the spot explains all matches; size = (width, height).

    `focal` in pixels where it is known; else every plausible one is tried, so that no wrong guess of it can hide a
    pure rotation.
    """
    steps = (xy[p.first][p.matches[:, 0]] - xy[p.second][p.matches[:, 1]] for p in pairs)
    far = [np.median(np.linalg.norm(step, axis=1)) > _MIN_DISPLACEMENT_PX for step in steps]
    moved = [p for p, is_far in zip(pairs, far, strict=True) if is_far]
    if not moved:
        return
    moved = moved[:: max(1, len(moved) // _SAMPLED_PAIRS)]
    unexplained = _least_unexplained(moved, xy, size, focal)
    if unexplained < _TURN_ONLY_PX:
        raise InputError(
            f"there is no parallax: turning the camera on the spot explains all matches of {len(moved)} pairs of views "
            f"to {unexplained:.1f} px, so no depth can be found. {HOW_TO_FILM}"
        )


def why_no_structure(views: int, pairs: Sequence[VerifiedPair]) -> str:
    """Say what may be wrong where no model was found of so many views, and what the matching pairs rule out."""
    if views < _FEWEST_VIEWS:
        return (
            f"{views} images are too few: one pair of them does not tell how the camera moved and what its focal "
            f"length is. Take at least {_FEWEST_VIEWS - views} more of the same place, each a step further to the side"
        )
    matched = len({view for pair in pairs for view in (pair.first, pair.second)})
    if matched < _MAX_MATCH * views:
        return (
            f"no structure could be found among {views} views; pairs that match: {len(pairs)}. {views - matched} views "
            "match no other. Possible causes: too little overlap, plain surfaces, blur, darkness, or things that move. "
            "Film more slowly, in better light, or give images closer together"
        )
    return (
        f"no structure could be found among {views} views; pairs that match: {len(pairs)}. {matched} views match "
        "others, which rules out blur and plain surfaces. Possible causes: different lenses, zooms or crops among the "
        "images, a fisheye lens (--camera fisheye, --intrinsics), a camera that hardly moves sideways, or things that "
        "move and fill the image"
    )


def _least_unexplained(
    pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float | None
) -> float:
    """Pixels that rotations leave in nine tenths of the pairs, at the best focal length."""
    # Not half: someone who turns slowly with the camera at arm's length has parallax in few pairs only.

    def unexplained(f: float) -> float:
        return float(np.percentile([rotation_residual(p, xy, size, f) for p in pairs], 90))

    if focal:
        return unexplained(focal)
    coarse = _COARSE_FOCALS * max(size)
    best = coarse[int(np.argmin([unexplained(f) for f in coarse]))]
    return min(unexplained(best * factor) for factor in _FINE_FACTORS)


def rotation_residual(
    pair: VerifiedPair, xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float
) -> float:
    """Pixels within which four fifths of a pair's matches obey the best rotation about the camera's centre."""
    centre = np.array(size) / 2
    first = _turned_rays(xy[pair.first][pair.matches[:, 0]] - centre, focal)
    second = _turned_rays(xy[pair.second][pair.matches[:, 1]] - centre, focal)
    angle = np.linalg.norm(first @ best_rotation(first, second).T - second, axis=1)
    return float(np.percentile(angle, 80) * focal)


def _turned_rays(xy: NDArray[np.float64], focal: float) -> NDArray[np.float64]:
    rays = np.concatenate([xy, np.full((len(xy), 1), focal)], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
