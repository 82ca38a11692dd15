"""The last bundle adjustment of the backbone, and how sure it is of the focal length."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.reconstruction import ModelArrays
from .lens import set_lens

CAUCHY_PX = 1.0
_MAX_REPROJECTION_PX = 4.0
_MIN_ANGLE_DEG = 1.0
_MIN_KEYFRAMES_TO_SPLIT = 8
_SPLIT_VIEWS = 60
_FINE, _ROUGH = 1e-6, 1e-4
"""An adjustment ends with a step that lowers the cost by less, relatively."""


def adjust(model: pycolmap.Reconstruction, refine_camera: bool, narrowly: bool = False) -> float:
    """Robust bundle adjustment of poses, points and, if asked, the camera, in place; wild observations removed.

    `narrowly`: poses and points once more, under a loss as wide as the median error. Where few points hold the path,
    those that are a pixel off must not have a say.

    A camera to be calibrated gets a second radial coefficient here: one is enough to find the structure, and too few
    to determine the focal length of a real lens.

    Returns the standard deviation of the focal length in pixels, 0 for a camera that is not refined. Three things add
    up in it: the noise of the observations, how far the focal length moves when the lens has one coefficient less,
    and how far its values from the first and the second half of the views are apart. The first alone is too sure of
    itself several times over, because rolling shutter and blur are no noise.
    """
    images = sorted(model.reg_image_ids())
    if refine_camera:
        focal_sd = _calibrate(model, images)
    else:
        focal_sd = 0.0
        for roughly in (True, False):
            solve(model, images, refine_camera=False, roughly=roughly)
            filter_outliers(model)
    if narrowly:
        solve(model, images, refine_camera=False, width=min(median_error(model), CAUCHY_PX))
        filter_outliers(model)
    return focal_sd


def _calibrate(model: pycolmap.Reconstruction, images: Sequence[int]) -> float:
    """The adjustment with the camera; the standard deviation of its focal length, see `adjust`."""
    solve(model, images, refine_camera=True, roughly=True)
    filter_outliers(model)
    simple_focal = float(model.cameras[1].focal_length)
    set_lens(model.cameras[1], 2)
    solve(model, images, refine_camera=True, roughly=True)
    filter_outliers(model)
    # Before points are removed: the adjuster keeps pointers into the model.
    formal = _formal_sd(model, solve(model, images, refine_camera=True))
    filter_outliers(model)
    focal = float(model.cameras[1].focal_length)
    return math.hypot(formal, focal - simple_focal, _difference_of_halves(model, images) / 2)


def solve(
    model: pycolmap.Reconstruction,
    images: Sequence[int],
    refine_camera: bool,
    width: float = CAUCHY_PX,
    bend_lens: bool = True,
    roughly: bool = False,
) -> pycolmap.CeresBundleAdjuster:
    """Robust adjustment of these images, in place, under Cauchy's loss of so many pixels; deterministic. A camera that
    is refined keeps its distortion unless `bend_lens`. `roughly`: for one that another adjustment follows."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = refine_camera
    options.refine_extra_params = refine_camera and bend_lens
    options.refine_sensor_from_rig = options.print_summary = False
    options.min_track_length = 2
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = width
    options.ceres.use_gpu = False
    solver = options.ceres.solver_options
    # Ceres adds up in the order its threads finish; one thread gives the same bytes every time.
    solver.num_threads = 1
    solver.max_num_iterations = 50
    solver.function_tolerance = _ROUGH if roughly else _FINE
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return adjuster


def reprojection_errors(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """(O,) pixels, of every observation, image after image; infinite behind the camera."""
    found, errors = ModelArrays.of(model), [np.zeros(0)]
    for image_id, pose, own in zip(found.image_ids.tolist(), found.cam_from_world, found.rows(), strict=True):
        if own.start == own.stop:
            continue
        points = found.points[found.obs_point[own]] @ pose[:3, :3].T + pose[:3, 3]
        projected = np.asarray(model.cameras[model.images[image_id].camera_id].img_from_cam(points))
        error = np.linalg.norm(projected - found.obs_xy[own], axis=1)
        errors.append(np.where((points[:, 2] > 0) & np.isfinite(error), error, np.inf))
    return np.concatenate(errors)


def median_error(model: pycolmap.Reconstruction) -> float:
    """Return the median reprojection error of all observations, in pixels; 0 without any."""
    errors = reprojection_errors(model)
    return float(np.median(errors)) if len(errors) else 0.0


def filter_outliers(model: pycolmap.Reconstruction) -> None:
    """Observations that the model contradicts, and points that are seen from one direction only, in place."""
    manager = pycolmap.ObservationManager(model)
    manager.filter_observations_with_negative_depth()
    manager.filter_all_points3D(_MAX_REPROJECTION_PX, _MIN_ANGLE_DEG)


def _formal_sd(model: pycolmap.Reconstruction, adjuster: pycolmap.CeresBundleAdjuster) -> float:
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(options, model, adjuster)
    camera = model.cameras[1]
    block = None if covariance is None else covariance.get_other_params_cov(camera.params)
    if block is None or not np.isfinite(block[0, 0]):
        # A problem that does not determine the focal length: say that it may be anything.
        return float(camera.focal_length)
    # The adjustment counts with residuals of one pixel a coordinate; the median norm of two is 1.18 of them.
    noise = median_error(model) / 1.1774
    return math.sqrt(max(float(block[0, 0]), 0.0)) * noise


def _difference_of_halves(model: pycolmap.Reconstruction, images: Sequence[int]) -> float:
    if len(images) < _MIN_KEYFRAMES_TO_SPLIT:
        return 0.0
    middle = len(images) // 2
    first, second = images[:middle][:_SPLIT_VIEWS], images[middle:][-_SPLIT_VIEWS:]
    return abs(_focal_of(model, first) - _focal_of(model, second))


def _focal_of(model: pycolmap.Reconstruction, images: Sequence[int]) -> float:
    part = pycolmap.Reconstruction(model)
    for image_id in sorted(set(model.reg_image_ids()) - set(images)):
        part.deregister_frame(part.images[image_id].frame_id)
    solve(part, images, refine_camera=True, roughly=True)
    return float(part.cameras[1].focal_length)
