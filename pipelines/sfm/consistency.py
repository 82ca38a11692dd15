"""Agreement of a model with the matches it was made from, and the scale along its path.

Two views agree by their epipolar lines whatever the length between them, so no pair of views contradicts a path whose
unit grows along the way. Three do: what a keyframe shows has one depth by the views before it and another by those
after it.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..geometry.camera import nearest_along
from .adjust import bundle_adjust, median_error, model_errors, robust_cost
from .components import (
    PairCheck,
    Seam,
    find_components,
    find_leaps,
    find_seams,
    tracks_of,
    worst_contradictions,
)
from .lens import distortion_of
from .matching import VerifiedPair
from .rolling import FILM

Array = NDArray[np.float64]

_MIN_ANGLE = np.radians(1.0)
"""Rays that are nearer to parallel give no depth."""
_MIN_FEATURES = 12
_MAX_ERROR = 2.0
"""Pixels from the epipolar line."""
_SURE = 3.0
"""Standard deviations that are taken off the drift."""
MAX_DRIFT = 1.25
"""A path is consistent up to this."""


@dataclass(frozen=True)
class ScaleDrift:
    """By what factor the unit of a path differs at least between two keyframes, `first` and `last`, and the one between
    at which it changes most; 1 for a path of one scale."""

    factor: float = 1.0
    first: int = 0
    last: int = 0
    at: int = 0


NO_DRIFT = ScaleDrift()

MIN_SELF_CALIBRATION_GAIN = 0.03
"""Of the cost that must go. Freed, a Kinect's calibration explained 0.013 more of a recording with rolling shutter and
blur, another Kinect's nominal 525 px 0.057."""
MIN_BETTER = 0.01
"""By how much less of the matches the model of the camera found anew must leave unexplained to be taken."""
_AGREE_PX = 4.0


@dataclass(frozen=True)
class ModelReport:
    """registered of total keyframes; median reprojection error in pixels; points.

    `agreement`: share of the verified matches between registered keyframes that are within 4 px of the epipolar line
    of the final poses; `pairs_agreeing`: share of the pairs of which more than half of the matches do. A folded
    trajectory leaves whole pairs that disagree, however small its reprojection error is. `seams` and `components`: see
    `find_seams` and `find_components`; they see one bad place among many good ones. `drift`: see `scale_drift`;
    `leaps`: keyframes before which a film's camera would have to leap, though images on both sides match.
    """

    registered: int
    total: int
    points: int
    reprojection_px: float
    agreement: float
    pairs_agreeing: float
    seams: tuple[Seam, ...]
    components: tuple[tuple[int, ...], ...]
    drift: ScaleDrift = NO_DRIFT
    leaps: tuple[int, ...] = ()

    @property
    def largest(self) -> tuple[int, ...]:
        """Return the part with most keyframes; empty where nothing is placed."""
        return self.components[0] if self.components else ()

    @property
    def contradicted(self) -> list[Seam]:
        """Seams where the path may be folded."""
        return worst_contradictions(self.seams)

    @property
    def score(self) -> float:
        """To choose between models of the same matches: larger is better."""
        return len(self.largest) / self.total * self.agreement * self.pairs_agreeing / self.drift.factor

    @property
    def is_whole(self) -> bool:
        """Return whether hardly any keyframe is missing."""
        return len(self.largest) >= 0.95 * self.total

    @property
    def is_sound(self) -> bool:
        """Return whether no other mapper need be asked: what it finds of the rest is a piece beside this."""
        return len(self.largest) >= 0.5 * self.total and self.is_consistent

    @property
    def is_consistent(self) -> bool:
        """Return whether what is placed agrees with the images."""
        return self.pairs_agreeing >= 0.9 and not self.contradicted and self.drift.factor < MAX_DRIFT


def judge(
    model: pycolmap.Reconstruction,
    pairs: Sequence[VerifiedPair],
    xy: Sequence[NDArray[np.float64]],
    total: int,
    reach: int,
    times: Array | None = None,
    breaks: Collection[int] = (),
    straight: Sequence[Array] | None = None,
) -> ModelReport:
    """Report on a model; `pairs` are indices i of keyframes whose image id is i + 1, `xy` their features' pixels.

    total: number of stations; keyframes i, i + total and so on are views from one place in several
    directions, and the report is about places. `reach`: places at most so many apart are neighbours. `times` (total,)
    of a film in seconds. `breaks`: places before which, as where the camera leaps or neighbours
    contradict the path, the seam counts as without a point.
    `straight`: pixels in frames taken at once, by which the drift of each component is measured, and not that of all.
    """
    checks = check_pairs(model, pairs, xy, total)
    matches, agreeing = sum(c.matches for c in checks), sum(c.agreeing for c in checks)
    views = {(i - 1) % total: model.images[i] for i in sorted(model.reg_image_ids())}
    placed, tracks = sorted(views), tracks_of(model, total)
    centers = np.array([views[k].projection_center() for k in placed]).reshape(-1, 3)
    seams = find_seams(placed, checks, tracks, reach)
    leaps: list[int] = []
    if times is not None:
        fast = [seams[n - 1] for n in find_leaps(centers, times[placed])]
        # Where nothing on one side matches the other, the film may have a cut, which takes no time.
        leaps = [s.after for s in fast if s.pairs or times[s.after] - times[s.before] > FILM]
    breaks = {*breaks, *leaps, *(s.after for s in worst_contradictions(seams))}
    seams = [replace(s, points=0) if s.after in breaks else s for s in seams]
    points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
    components = find_components(placed, seams, tracks, points, reach, breaks)
    parts, seen = ([placed], xy) if straight is None else (components, straight)
    drifts = (scale_drift(model, pairs, seen, total, reach, part) for part in parts)
    return ModelReport(
        len(placed), total, model.num_points3D(), median_error(model),
        agreeing / max(matches, 1), sum(c.agrees for c in checks) / max(len(checks), 1),
        tuple(seams), tuple(map(tuple, components)), max(drifts, key=lambda d: d.factor, default=NO_DRIFT),
        tuple(leaps),
    )  # fmt: skip


def check_pairs(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], total: int
) -> list[PairCheck]:
    """Count the matches of each pair of placed keyframes that agree with their poses; by station, see `judge`."""
    checks = []
    for pair, error in matched_errors(model, pairs, xy):
        first, second = sorted((pair.first % total, pair.second % total))
        checks.append(PairCheck(first, second, len(error), int((error < _AGREE_PX).sum())))
    return checks


def matched_errors(
    model: pycolmap.Reconstruction, pairs: Iterable[VerifiedPair], xy: Sequence[NDArray[np.float64]]
) -> Iterator[tuple[VerifiedPair, NDArray[np.float64]]]:
    """Return the pairs of placed keyframes and their matches' distances (M,) to the epipolar lines in pixels."""
    camera = model.cameras[1]
    rays = {i - 1: np.asarray(camera.cam_from_img(xy[i - 1])) for i in model.reg_image_ids()}
    poses = {i: model.images[i + 1].cam_from_world().matrix() for i in rays}
    focal = camera.mean_focal_length()
    for pair in pairs:
        if pair.first in rays and pair.second in rays:
            error = epipolar_error(
                poses[pair.first], poses[pair.second],
                rays[pair.first][pair.matches[:, 0]], rays[pair.second][pair.matches[:, 1]],
            )  # fmt: skip
            yield pair, error * focal


def epipolar_error(
    first_from_world: NDArray[np.float64],
    second_from_world: NDArray[np.float64],
    first: NDArray[np.float64],
    second: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(M,) distance of matches (M, 2), in normalised coordinates, to the epipolar lines: the root of Sampson's error.

    Poses are (3, 4) or (4, 4). Where the two centres coincide the error of the rotation alone is given.
    """
    rotation = second_from_world[:3, :3] @ first_from_world[:3, :3].T
    translation = second_from_world[:3, 3] - rotation @ first_from_world[:3, 3]
    a = np.concatenate([first, np.ones((len(first), 1))], axis=1)
    b = np.concatenate([second, np.ones((len(second), 1))], axis=1)
    length = np.linalg.norm(translation)
    if length < 1e-12:
        turned = a @ rotation.T
        return np.linalg.norm(turned[:, :2] / turned[:, 2:] - second, axis=1)
    x, y, z = translation / length
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    line_b, line_a = a @ essential.T, b @ essential
    residual = (b * line_b).sum(1)
    scale = (line_a[:, :2] ** 2).sum(1) + (line_b[:, :2] ** 2).sum(1)
    return np.abs(residual) / np.sqrt(np.maximum(scale, 1e-300))


def self_calibration_gain(model: pycolmap.Reconstruction) -> float:
    """Return the share of the robust reprojection cost that goes when a held camera is adjusted with poses and points:
    its focal lengths, and two radial coefficients where it states no distortion. The model stays as it is; its
    observations are where frames taken at once would have them, for a free lens bends itself to a rolling shutter."""
    freed = pycolmap.Reconstruction(model)
    camera = freed.cameras[1]
    bends = not any(distortion_of(camera))
    if bends:
        middle = camera.principal_point_x, camera.principal_point_y
        params = [camera.mean_focal_length(), *middle, 0.0, 0.0]
        camera.model, camera.params = pycolmap.CameraModelId.RADIAL, params
    before = robust_cost(model_errors(model))
    bundle_adjust(freed, sorted(freed.reg_image_ids()), refine_camera=True, bend_lens=bends)
    return 1 - robust_cost(model_errors(freed)) / max(before, 1e-12)


def unexplained(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]]
) -> float:
    """Return the mean robust cost of the distances of all verified matches to their epipolar lines under a model's
    poses and camera, whichever of them its points are made of."""
    errors = [error for _, error in matched_errors(model, pairs, xy)]
    return robust_cost(np.concatenate(errors)) if errors else float("inf")


# scale along the path --------------------------------------------------------------------------------------------


def scale_drift(
    model: pycolmap.Reconstruction,
    pairs: Sequence[VerifiedPair],
    xy: Sequence[Array],
    total: int,
    reach: int,
    within: Iterable[int],
) -> ScaleDrift:
    """Measure how the scale of a path changes `within` places, by matches of keyframes at most `reach` apart; other
    arguments as of `consistency.judge`. Of panoramas the first direction is measured."""
    camera, focal = model.cameras[1], model.cameras[1].mean_focal_length()
    poses = {k: model.images[k + 1].cam_from_world().matrix() for k in within}
    rays = {k: unit_rays(camera, xy[k]) for k in poses}
    sides: dict[int, tuple[_Side, _Side]] = defaultdict(lambda: (_Side(), _Side()))
    for pair in pairs:
        i, j = sorted((pair.first, pair.second))
        if i not in poses or j not in poses or not 0 < j - i <= reach:
            continue
        matches = pair.matches if pair.first == i else pair.matches[:, ::-1]
        seen = rays[i][matches[:, 0]], rays[j][matches[:, 1]]
        depth_i, depth_j, angle, off = _depths(poses[i], poses[j], *seen)
        good = (angle > _MIN_ANGLE) & (off * focal < _MAX_ERROR) & (depth_i > 0) & (depth_j > 0)
        sides[i][1].add(matches[good, 0], depth_i[good], angle[good], j - i)
        sides[j][0].add(matches[good, 1], depth_j[good], angle[good], j - i)
    steps, variances = np.zeros(total), np.zeros(total)
    for k, (before, after) in sides.items():
        steps[k], variances[k] = _growth(before, after, len(xy[k]))
    along = np.concatenate([[0.0], np.cumsum(steps)])
    doubt = np.concatenate([[0.0], np.cumsum(variances)])
    apart = np.abs(along[:, None] - along[None]) - _SURE * np.sqrt(np.abs(doubt[:, None] - doubt[None]) * 2 * reach)
    first, last = sorted(np.unravel_index(int(np.argmax(apart)), apart.shape))
    if not apart[first, last] > 0:
        return NO_DRIFT
    growing = np.sign(along[last] - along[first]) * steps[first:last]
    return ScaleDrift(float(np.exp(apart[first, last])), int(first), int(last) - 1, int(first + growing.argmax()))


class _Side:
    """Depths of a keyframe's features by views on one side of it."""

    def __init__(self) -> None:
        self.features: list[NDArray[np.int64]] = []
        self.rows: list[Array] = []

    def add(self, features: NDArray[np.uint32], depth: Array, angle: Array, apart: int) -> None:
        self.features.append(features.astype(np.int64))
        self.rows.append(np.column_stack([angle**2, np.log(depth) * angle**2, np.full(len(depth), apart) * angle**2]))

    def mean(self, count: int) -> Array:
        """(count, 3) of every feature the sum of the weights, and weighted means of log depth and of the distance."""
        sums = np.zeros((count, 3))
        for features, rows in zip(self.features, self.rows, strict=True):
            np.add.at(sums, features, rows)
        sums[:, 1:] /= np.maximum(sums[:, :1], 1e-12)
        return sums


def _growth(before: _Side, after: _Side, count: int) -> tuple[float, float]:
    """By how much the logarithm of the unit grows from a keyframe to the next, and its variance."""
    a, b = before.mean(count), after.mean(count)
    both = (a[:, 0] > 0) & (b[:, 0] > 0)
    if both.sum() < _MIN_FEATURES:
        return 0.0, 0.0
    # A depth by a view twice as far along the path is off by half of what has grown on the way.
    span = (a[both, 2] + b[both, 2]) / 2
    growth = (b[both, 1] - a[both, 1]) / span
    middle = float(np.median(growth))
    spread = 1.4826 * float(np.median(np.abs(growth - middle)))
    return middle, 1.57 * spread**2 / both.sum()


def unit_rays(camera: pycolmap.Camera, xy: Array) -> Array:
    """Return the rays (F, 3) of pixels (F, 2), unit vectors in the camera."""
    rays = np.column_stack([np.asarray(camera.cam_from_img(xy)), np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _depths(first: Array, second: Array, a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """Depths (M,) along unit rays a and b (M, 3) where they are nearest, their angle, and the angle of the gap."""
    rotation = second[:, :3] @ first[:, :3].T
    move = second[:, 3] - rotation @ first[:, 3]  # where the first centre lies in the second camera
    turned = a @ rotation.T
    cosine = (turned * b).sum(1)
    depth_a, depth_b = nearest_along(turned, b, -move, cosine)
    angle = np.arcsin(np.minimum(np.sqrt(np.maximum(1 - cosine**2, 1e-12)), 1.0))
    gap = np.linalg.norm(move + depth_a[:, None] * turned - depth_b[:, None] * b, axis=1)
    return depth_a, depth_b, angle, gap / np.maximum(np.minimum(depth_a, depth_b), 1e-9)
