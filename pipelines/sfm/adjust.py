"""The last bundle adjustment of the backbone, and how sure it is of the focal length."""

import math
from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import ModelArrays
from .lens import set_lens

CAUCHY_PX = 1.0
LOSS_SD = CAUCHY_PX / 2
"""Pixels: by this deviation of its observations a `Bundle`, whose loss is two deviations wide, has the same loss. Not
how good features are: see `FEATURE_SD`."""
FEATURE_SD = 0.35
"""Pixels: how exactly a feature of structure from motion is known. Measured 0.2 to 0.3, at small scales and large ones;
chosen on seven recordings: six paths are better than with 0.5 (by 0.1 to 24 %), one worse (by 0.5)."""
_MAX_REPROJECTION_PX = 4.0
_FARTHEST_PX = 100.0
"""Errors count at most as much as this: of false matches nobody knows how wrong they are."""
_MIN_ANGLE_DEG = 1.0
_MIN_KEYFRAMES_TO_SPLIT = 8
_SPLIT_VIEWS = 60
CORRELATED, _SIGNIFICANT = 5.0, 3.0
"""By how much deviations of the camera exceed those of independent errors: features of one corner repeat theirs, and
rolling shutter and blur are no noise (2 to 9 times in rendered rooms). And from how many deviations on a radial
coefficient is one: 0.02 to 0.9 where there is none, from 2.6 on for a k1 of 0.05."""
_MIN_NOISE = 1e-6
"""Pixels: of a model without any, so that a covariance can be inverted."""
_FINE, _ROUGH = 1e-6, 1e-4
"""An adjustment ends with a step that lowers the cost by less, relatively."""


def adjust_model(model: pycolmap.Reconstruction, refine_camera: bool, narrowly: bool = False) -> float:
    """Robust bundle adjustment of poses, points and, if asked, the camera, in place; wild observations removed.

    `narrowly`: poses and points once more, under a loss as wide as the median error. Where few points hold the path,
    those that are a pixel off must not have a say.

    A camera to be calibrated keeps no more radial coefficients than the images demand, of two: see `_calibrate`.

    Returns the standard deviation of the focal length in pixels, 0 for a camera that is not refined. Three things add
    up in it: the noise of the observations, how far the focal length moves when the lens has one coefficient more or
    less, and how far its values from the first and the second half of the views are apart.
    """
    images = sorted(model.reg_image_ids())
    if refine_camera:
        focal_sd = _calibrate(model, images)
    else:
        focal_sd = 0.0
        for roughly in (True, False):
            bundle_adjust(model, images, refine_camera=False, roughly=roughly)
            filter_outliers(model)
    if narrowly:
        bundle_adjust(model, images, refine_camera=False, width=min(median_error(model), CAUCHY_PX))
        filter_outliers(model)
    return focal_sd


def _calibrate(model: pycolmap.Reconstruction, images: Sequence[int]) -> float:
    """Adjust with the camera; return the standard deviation of its focal length."""
    # Coefficients that are not significant are zero: most lenses of phones and all renderings have none, and one that
    # is free takes the focal length along. In rendered rooms that is 0.3 to 2 % instead of 0.1 to 0.3.
    camera = model.cameras[1]
    bundle_adjust(model, images, refine_camera=True, roughly=True)
    filter_outliers(model)
    set_lens(camera, 2)
    bundle_adjust(model, images, refine_camera=True, roughly=True)
    filter_outliers(model)
    # Before points are removed: the adjuster keeps pointers into the model.
    covariance = _lens_covariance(model, bundle_adjust(model, images, refine_camera=True))
    focals, count = _by_coefficients(np.array(camera.params)[[0, 3, 4]], covariance)
    if count < 2:
        camera.params = [focals[count], *camera.params[1:3], *[p * (count > 0) for p in camera.params[3:]]]
        set_lens(camera, 1)
        covariance = _lens_covariance(model, bundle_adjust(model, images, refine_camera=True, bend_lens=count > 0))
    filter_outliers(model)
    order = abs(focals[count] - focals[1 if count != 1 else 2]) / (1 if count else 2)
    halves = _difference_of_halves(model, images, count > 0)
    return math.hypot(CORRELATED * math.sqrt(covariance[0, 0]), order, halves / 2)


def _by_coefficients(fitted: NDArray[np.float64], covariance: NDArray[np.float64]) -> tuple[list[float], int]:
    """Focal lengths with no, one and two radial coefficients, to first order; how many coefficients are significant."""
    focals, count = [float(fitted[0])], 2
    for held in ([2], [1, 2]):
        block = covariance[np.ix_(held, held)]
        solved = np.linalg.solve(block, fitted[held])
        focals.insert(0, float(fitted[0] - covariance[0, held] @ solved))
        if fitted[held] @ solved < (_SIGNIFICANT * CORRELATED) ** 2:
            count = 2 - len(held)
    return focals, count


def bundle_adjust(
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


def model_errors(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
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
    errors = model_errors(model)
    return float(np.median(errors)) if len(errors) else 0.0


def robust_cost(errors: NDArray[np.float64]) -> float:
    """Return the mean of Cauchy's loss at a pixel's width of errors (O,) in pixels; NaN counts as far off."""
    return float(np.log1p(np.nan_to_num(errors, nan=_FARTHEST_PX).clip(max=_FARTHEST_PX) ** 2).mean())


def filter_outliers(model: pycolmap.Reconstruction) -> None:
    """Remove outlier observations and points with too small a triangulation angle, in place."""
    manager = pycolmap.ObservationManager(model)
    manager.filter_observations_with_negative_depth()
    manager.filter_all_points3D(_MAX_REPROJECTION_PX, _MIN_ANGLE_DEG)


def _lens_covariance(model: pycolmap.Reconstruction, adjuster: pycolmap.CeresBundleAdjuster) -> NDArray[np.float64]:
    """Covariance (P, P) of the refined camera, focal length first, for independent errors; huge where undetermined."""
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(options, model, adjuster)
    camera = model.cameras[1]
    block = None if covariance is None else covariance.get_other_params_cov(camera.params)
    if block is None or not np.isfinite(block).all() or not (np.diag(block) > 0).all():
        return np.diag([camera.focal_length**2, 1.0, 1.0])
    # The adjustment counts with residuals of one pixel a coordinate; the median norm of two is 1.18 of them.
    return np.asarray(block) * (max(median_error(model), _MIN_NOISE) / 1.1774) ** 2


def focals_of_halves(model: pycolmap.Reconstruction) -> list[tuple[float, float]]:
    """Return the focal length and its standard deviation, in pixels, that the first and the second half of the views
    tell, each adjusted by itself with the lens's distortion as it is; of few views what all of them tell."""
    found = []
    for half in _halves(sorted(model.reg_image_ids())):
        part = _part(model, half)
        bundle_adjust(part, half, refine_camera=True, bend_lens=False, roughly=True)
        covariance = _lens_covariance(part, bundle_adjust(part, half, refine_camera=True, bend_lens=False))
        found.append((float(part.cameras[1].mean_focal_length()), CORRELATED * math.sqrt(covariance[0, 0])))
    return found


def _difference_of_halves(model: pycolmap.Reconstruction, images: Sequence[int], bend_lens: bool) -> float:
    halves = _halves(images)
    if len(halves) < 2:
        return 0.0
    first, second = (_focal_of(model, half, bend_lens) for half in halves)
    return abs(first - second)


def _halves(images: Sequence[int]) -> list[Sequence[int]]:
    """The first and the last views, at most `_SPLIT_VIEWS` each; few views are not split."""
    if len(images) < _MIN_KEYFRAMES_TO_SPLIT:
        return [images]
    middle = len(images) // 2
    return [images[:middle][:_SPLIT_VIEWS], images[middle:][-_SPLIT_VIEWS:]]


def _focal_of(model: pycolmap.Reconstruction, images: Sequence[int], bend_lens: bool) -> float:
    part = _part(model, images)
    bundle_adjust(part, images, refine_camera=True, bend_lens=bend_lens, roughly=True)
    return float(part.cameras[1].focal_length)


def _part(model: pycolmap.Reconstruction, images: Sequence[int]) -> pycolmap.Reconstruction:
    part = pycolmap.Reconstruction(model)
    for image_id in sorted(set(model.reg_image_ids()) - set(images)):
        frame = part.images[image_id].frame_id
        part.deregister_frame(frame)
        part.frames[frame].rig_from_world = pycolmap.Rigid3d()  # the covariance asks for those of all frames
    return part
