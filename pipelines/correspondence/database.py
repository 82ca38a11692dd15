"""COLMAP's database, written anew from arrays: pycolmap's mappers read nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..types import Features
from .matching import VerifiedPair


def write_database(
    path: Path,
    camera: pycolmap.Camera,
    names: Sequence[str],
    features: Iterable[Features],
    pairs: Iterable[VerifiedPair],
    cam_from_rig: NDArray[np.float64],
) -> None:
    """Image i (counted from 0) gets the id i + 1. An older file is replaced.

    cam_from_rig (C, 3, 3): the images are those of the first of C directions, then those of the next and so on, each
    direction a camera of its own, counted from 1. The images i, i + N / C and so on share a frame of COLMAP.
    """
    path.unlink(missing_ok=True)
    stations = len(names) // len(cam_from_rig)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        rig, cameras = _write_rig(database, camera, cam_from_rig)
        frames = [pycolmap.Frame(rig_id=rig) for _ in range(stations)]
        for i, (name, feature) in enumerate(zip(names, features, strict=True)):
            image = pycolmap.Image(name=name, camera_id=cameras[i // stations])
            image.image_id = database.write_image(image)
            frames[i % stations].add_data_id(image.data_id)
            database.write_keypoints(image.image_id, feature.keypoints)
        for station, frame in enumerate(frames, 1):
            assert database.write_frame(frame) == station, "frames and the first images are numbered alike"
        for pair in pairs:
            _write_pair(database, pair)


def _write_rig(
    database: pycolmap.Database, camera: pycolmap.Camera, cam_from_rig: NDArray[np.float64]
) -> tuple[int, list[int]]:
    cameras = [database.write_camera(camera)]
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras[0]))
    for rotation in cam_from_rig[1:]:
        cameras.append(database.write_camera(pycolmap.Camera(camera.todict() | {"camera_id": len(cameras) + 1})))
        turned = pycolmap.Rigid3d(np.column_stack([rotation, np.zeros(3)]))
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras[-1]), turned)
    return database.write_rig(rig), cameras


def _write_pair(database: pycolmap.Database, pair: VerifiedPair) -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pair.config
    geometry.inlier_matches = pair.matches
    for name, matrix in zip("FEH", pair.matrices, strict=True):
        if matrix.any():
            setattr(geometry, name, matrix)
    database.write_matches(pair.first + 1, pair.second + 1, pair.matches)
    database.write_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
