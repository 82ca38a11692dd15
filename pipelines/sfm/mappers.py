"""pycolmap's two mappers, one thread each so that the same database gives the same bytes."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import pycolmap

_ANY_DISTORTION = 1e9
"""COLMAP takes a camera with a coefficient above 1 for one that ran away, and places no view of it. One that is held
cannot run away, and real ones have such: the third radial one of a Kinect is 1.16."""
# pycolmap reports each step on stderr, through the progress bars; failures are reported by the caller.
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
# Its import makes a process that is asked to end print a stack trace first: back to what there was before.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is not None:
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def map_globally(database: Path, work: Path, refine_camera: bool, seed: int) -> pycolmap.Reconstruction | None:
    """Poses of all images at once (Pan et al., Global Structure-from-Motion Revisited, ECCV 2024); None on failure."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.refine_focal_length = refine_camera
    mapper.bundle_adjustment.refine_extra_params = refine_camera
    mapper.refine_sensor_from_rig = mapper.bundle_adjustment.refine_sensor_from_rig = False
    # Two thirds of the time with 300, and poses as good on nine recordings: the longest tracks hold the views together
    # as well as all do, and the last adjustment has all of them again.
    mapper.track_required_tracks_per_view, mapper.ba_num_iterations = 150, 2
    if not refine_camera:
        mapper.retriangulation.max_extra_param = _ANY_DISTORTION
    return _largest(pycolmap.global_mapping(database, work, work, options))


def map_incrementally(
    database: Path, work: Path, refine_camera: bool, seed: int, start: pycolmap.Reconstruction | None = None
) -> pycolmap.Reconstruction | None:
    """Poses image by image (Schönberger and Frahm, Structure-from-Motion Revisited, CVPR 2016); None on failure. A
    model of images in the database to `start` from keeps its poses; others are added to it."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 3
    options.ba_refine_sensor_from_rig = False
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = refine_camera
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = refine_camera
    if not refine_camera:
        options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = (
            _ANY_DISTORTION
        )
    if start is None:
        return _largest(pycolmap.incremental_mapping(database, work, work, options))
    options.fix_existing_frames, options.multiple_models = True, False
    (before := work / "start").mkdir()
    start.write_binary(before)
    return _largest(pycolmap.incremental_mapping(database, work, work, options, before))


def _largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    usable = [m for m in models.values() if m.num_reg_images() >= 2 and m.num_points3D() > 0]
    return max(usable, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
