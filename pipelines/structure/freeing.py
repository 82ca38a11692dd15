"""A stated camera that the images contradict.

What a data set's file says of its camera may be true of the kind of camera only, or of another one. Such numbers are a
start: they are held as long as freeing them explains the images hardly better.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..correspondence.matching import VerifiedPair
from .adjust import reprojection_errors, solve
from .consistency import matched_errors
from .lens import distortion_of

LEAST_GAIN_OF_FREEING = 0.03
"""Of the cost that must go. Freed, a Kinect's calibration explained 0.013 more of a recording with rolling shutter and
blur, another Kinect's nominal 525 px 0.057."""
LEAST_BETTER = 0.01
"""By how much less of the matches the model of the camera found anew must leave unexplained to be taken."""
_FARTHEST_PX = 100.0
"""Errors count at most as much as this: of false matches nobody knows how wrong they are."""


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
    before = _cost(reprojection_errors(model))
    solve(freed, sorted(freed.reg_image_ids()), refine_camera=True, bend_lens=bends)
    return 1 - _cost(reprojection_errors(freed)) / max(before, 1e-12)


def unexplained(
    model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]]
) -> float:
    """Return the mean robust cost of the distances of all verified matches to their epipolar lines under a model's
    poses and camera, whichever of them its points are made of."""
    errors = [error for _, error in matched_errors(model, pairs, xy)]
    return _cost(np.concatenate(errors)) if errors else float("inf")


def _cost(errors: NDArray[np.float64]) -> float:
    """Mean of Cauchy's loss at a pixel's width."""
    return float(np.log1p(np.nan_to_num(errors, nan=_FARTHEST_PX).clip(max=_FARTHEST_PX) ** 2).mean())
