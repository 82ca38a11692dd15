"""Agreement of a model with the matches it was made from."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pycolmap
from numpy.typing import NDArray

from .adjust import median_error, reprojection_errors, robust_cost, solve
from .drift import MAX_DRIFT, NO_DRIFT, ScaleDrift, scale_drift
from .lens import distortion_of
from .matching import VerifiedPair
from .seams import (
    PairCheck,
    Seam,
    find_misplaced,
    find_parts,
    find_seams,
    remove_keyframes,
    tracks_of,
    worst_contradictions,
)

MIN_GAIN_OF_FREEING = 0.03
"""Of the cost that must go. Freed, a Kinect's calibration explained 0.013 more of a recording with rolling shutter and
blur, another Kinect's nominal 525 px 0.057."""
MIN_BETTER = 0.01
"""By how much less of the matches the model of the camera found anew must leave unexplained to be taken."""
_AGREE_PX = 4.0
_MAX_MISPLACED = 0.2


@dataclass(frozen=True)
class ModelReport:
    """registered of total keyframes; median reprojection error in pixels; points.

    `agreement`: share of the verified matches between registered keyframes that are within 4 px of the epipolar line
    of the final poses; `pairs_agreeing`: share of the pairs of which more than half of the matches do. A folded
    trajectory leaves whole pairs that disagree, however small its reprojection error is. `seams` and `parts`: see
    `find_seams` and `find_parts`; they see one bad place among many good ones. `drift`: see `scale_drift`; no pair of
    views contradicts a path whose scale changes along it.
    """

    registered: int
    total: int
    points: int
    reprojection_px: float
    agreement: float
    pairs_agreeing: float
    seams: tuple[Seam, ...]
    parts: tuple[tuple[int, ...], ...]
    drift: ScaleDrift = NO_DRIFT

    @property
    def largest(self) -> tuple[int, ...]:
        """The part with most keyframes; empty where nothing is placed."""
        return self.parts[0] if self.parts else ()

    @property
    def contradicted(self) -> list[Seam]:
        """Seams where the path may be folded."""
        return worst_contradictions(self.seams)

    @property
    def score(self) -> float:
        """To choose between models of the same matches: larger is better."""
        cuts = [s.after for s in self.contradicted]
        runs = [sum(1 for k in self.largest if a <= k < b) for a, b in pairwise([0, *cuts, self.total])]
        return max(runs) / self.total * self.agreement * self.pairs_agreeing / self.drift.factor

    @property
    def is_whole(self) -> bool:
        """Whether hardly any keyframe is missing."""
        return len(self.largest) >= 0.95 * self.total

    @property
    def is_sound(self) -> bool:
        """Whether the other mapper need not be asked: what another one finds of the rest is a piece beside this."""
        return len(self.largest) >= 0.5 * self.total and self.is_consistent

    @property
    def is_consistent(self) -> bool:
        """Whether what is placed agrees with the images."""
        return self.pairs_agreeing >= 0.9 and not self.contradicted and self.drift.factor < MAX_DRIFT


def judge(
    model: pycolmap.Reconstruction,
    pairs: Sequence[VerifiedPair],
    xy: Sequence[NDArray[np.float64]],
    total: int,
    reach: int,
) -> ModelReport:
    """Report on a model; `pairs` are indices i of keyframes whose image id is i + 1, `xy` their features' pixels.

    total: number of stations; keyframes i, i + total and so on are views from one place in several
    directions, and the report is about places. `reach`: places at most so many apart are neighbours.
    """
    checks = check_pairs(model, pairs, xy, total)
    matches, agreeing = sum(c.matches for c in checks), sum(c.agreeing for c in checks)
    placed, tracks = sorted({(i - 1) % total for i in model.reg_image_ids()}), tracks_of(model, total)
    seams = find_seams(placed, checks, tracks, reach)
    parts = find_parts(placed, seams, tracks, reach)
    return ModelReport(
        len(placed), total, model.num_points3D(), median_error(model),
        agreeing / max(matches, 1), sum(c.agrees for c in checks) / max(len(checks), 1),
        tuple(seams), tuple(map(tuple, parts)), scale_drift(model, pairs, xy, total, reach),
    )  # fmt: skip


def without_misplaced(
    model: pycolmap.Reconstruction,
    pairs: Sequence[VerifiedPair],
    xy: Sequence[NDArray[np.float64]],
    total: int,
    reach: int,
) -> pycolmap.Reconstruction:
    """The model, keyframes that their neighbours contradict taken out of it in place; arguments as of `judge`."""
    misplaced = find_misplaced(check_pairs(model, pairs, xy, total), reach)
    if 0 < len(misplaced) <= _MAX_MISPLACED * model.num_reg_frames():  # of more, who knows which are right
        remove_keyframes(model, misplaced)
    return model


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
    """The pairs of placed keyframes, with the distances (M,) of their matches to the epipolar lines in pixels."""
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


def gain_of_freeing(model: pycolmap.Reconstruction) -> float:
    """The share of the robust reprojection cost that goes when a held camera is adjusted with poses and points: its
    focal lengths, and two radial coefficients where it states no distortion. The model stays as it is; its observations
    are where frames taken at once would have them, for a free lens bends itself to a rolling shutter."""
    freed = pycolmap.Reconstruction(model)
    camera = freed.cameras[1]
    bends = not any(distortion_of(camera))
    if bends:
        middle = camera.principal_point_x, camera.principal_point_y
        params = [camera.mean_focal_length(), *middle, 0.0, 0.0]
        camera.model, camera.params = pycolmap.CameraModelId.RADIAL, params
    before = robust_cost(reprojection_errors(model))
    solve(freed, sorted(freed.reg_image_ids()), refine_camera=True, bend_lens=bends)
    return 1 - robust_cost(reprojection_errors(freed)) / max(before, 1e-12)


def unexplained(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]]
) -> float:
    """Return the mean robust cost of the distances of all verified matches to their epipolar lines under a model's
    poses and camera, whichever of them its points are made of."""
    errors = [error for _, error in matched_errors(model, pairs, xy)]
    return robust_cost(np.concatenate(errors)) if errors else float("inf")
