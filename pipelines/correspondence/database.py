"""COLMAP's database, written anew from arrays: pycolmap's mappers read nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pycolmap

from pipelines.correspondence.matching import VerifiedPair
from pipelines.types import Features


def write_database(
    path: Path,
    camera: pycolmap.Camera,
    names: Sequence[str],
    features: Iterable[Features],
    pairs: Iterable[VerifiedPair],
) -> None:
    """Image i (counted from 0) gets the id i + 1; all images share camera 1. An older file is replaced."""
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        camera_id = database.write_camera(camera)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        rig_id = database.write_rig(rig)
        for name, feature in zip(names, features, strict=True):
            _write_image(database, name, feature, camera_id, rig_id)
        for pair in pairs:
            _write_pair(database, pair)


def _write_image(database: pycolmap.Database, name: str, features: Features, camera_id: int, rig_id: int) -> None:
    image = pycolmap.Image(name=name, camera_id=camera_id)
    image.image_id = database.write_image(image)
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    frame.add_data_id(image.data_id)
    frame_id = database.write_frame(frame)
    assert frame_id == image.image_id, "frames and images are numbered alike"
    database.write_keypoints(image.image_id, features.keypoints)


def _write_pair(database: pycolmap.Database, pair: VerifiedPair) -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pair.config
    geometry.inlier_matches = pair.matches
    for name, matrix in zip("FEH", pair.matrices, strict=True):
        if matrix.any():
            setattr(geometry, name, matrix)
    database.write_matches(pair.first + 1, pair.second + 1, pair.matches)
    database.write_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
