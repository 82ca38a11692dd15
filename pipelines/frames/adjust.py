"""The last bundle adjustment of the backbone, and how sure it is of the focal length."""

from __future__ import annotations

import numpy as np
import pycolmap

_CAUCHY_PX = 1.0
_FINAL_REPROJECTION_PX = 4.0
_FINAL_ANGLE_DEG = 1.0


def adjust(model: pycolmap.Reconstruction, refine_camera: bool) -> float:
    """Robust bundle adjustment of poses, points and, if asked, the camera, in place; wild observations removed.

    Returns the standard deviation of the focal length in pixels, 0 for a camera that is not refined. It is the formal
    one of the adjustment: noise of the observations as measured by their residuals, and nothing for what the camera
    model cannot express.
    """
    adjuster = _solve(model, refine_camera)
    manager = pycolmap.ObservationManager(model)
    manager.filter_all_points3D(_FINAL_REPROJECTION_PX, _FINAL_ANGLE_DEG)
    adjuster = _solve(model, refine_camera)
    model.update_point_3d_errors()
    return _focal_sd(model, adjuster) if refine_camera else 0.0


def _solve(model: pycolmap.Reconstruction, refine_camera: bool) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = refine_camera
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _CAUCHY_PX
    options.ceres.use_gpu = False
    solver = options.ceres.solver_options
    # Ceres adds up in the order its threads finish; one thread gives the same bytes every time.
    solver.num_threads = 1
    solver.max_num_iterations = 50
    solver.function_tolerance = 1e-7
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    return adjuster


def _focal_sd(model: pycolmap.Reconstruction, adjuster: pycolmap.CeresBundleAdjuster) -> float:
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(options, model, adjuster)
    camera = model.cameras[1]
    block = None if covariance is None else covariance.get_other_params_cov(camera.params)
    if block is None:
        # A problem that does not determine the focal length: say that it may be anything.
        return float(camera.mean_focal_length())
    # The adjustment counts with residuals of one pixel a coordinate; the error stored is the norm of two.
    residual = float(model.compute_mean_reprojection_error()) / np.sqrt(np.pi / 2)
    return float(np.sqrt(max(block[0, 0], 0.0)) * max(residual, 1e-3))
