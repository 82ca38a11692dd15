"""How well a model agrees with the matches it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from pipelines.frames.adjust import reprojection_errors
from pipelines.frames.matching import VerifiedPair

_AGREE_PX = 4.0
_PAIR_AGREES = 0.5


@dataclass(frozen=True)
class ModelReport:
    """registered of total keyframes; median reprojection error in pixels; points.

    `agreement`: share of the verified matches between registered keyframes that lie within 4 px of the epipolar line
    of the final poses; `pairs_agreeing`: share of the pairs of which more than half of the matches do. A folded
    trajectory leaves whole pairs that disagree, however small its reprojection error is.
    """

    registered: int
    total: int
    points: int
    reprojection_px: float
    agreement: float
    pairs_agreeing: float

    @property
    def score(self) -> float:
        """To choose between models of the same matches: larger is better."""
        return self.registered / self.total * self.agreement * self.pairs_agreeing

    @property
    def is_sound(self) -> bool:
        """Whether the other mapper need not be asked."""
        return self.registered >= 0.95 * self.total and self.pairs_agreeing >= 0.9


def judge(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], total: int
) -> ModelReport:
    """Report on a model; `pairs` are indices i of keyframes whose image id is i + 1, `xy` their features' pixels."""
    camera = model.cameras[1]
    rays = {i - 1: np.asarray(camera.cam_from_img(xy[i - 1])) for i in model.reg_image_ids()}
    poses = {i: model.images[i + 1].cam_from_world().matrix() for i in rays}
    focal = camera.mean_focal_length()
    agreeing, matches, good_pairs, seen = 0, 0, 0, 0
    for pair in pairs:
        if pair.first not in rays or pair.second not in rays:
            continue
        error = epipolar_error(
            poses[pair.first], poses[pair.second],
            rays[pair.first][pair.matches[:, 0]], rays[pair.second][pair.matches[:, 1]],
        )  # fmt: skip
        agree = int((error * focal < _AGREE_PX).sum())
        agreeing, matches = agreeing + agree, matches + len(error)
        good_pairs, seen = good_pairs + (agree > _PAIR_AGREES * len(error)), seen + 1
    return ModelReport(
        model.num_reg_images(), total, model.num_points3D(), float(np.median(reprojection_errors(model))),
        agreeing / max(matches, 1), good_pairs / max(seen, 1),
    )  # fmt: skip


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
